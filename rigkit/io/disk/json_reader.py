"""JSON as rigkit writes it, and a strict reader: no duplicate key, no oversized number, no NaN."""

from __future__ import annotations

import json
import math
import re
from collections import Counter
from collections.abc import Collection
from pathlib import Path
from typing import Any

import numpy as np

from rigkit.core.arrays import FloatArray
from rigkit.core.errors import InputError
from rigkit.io.disk.reading import MAX_NUMBER, MIN_POSITIVE, read_text

MAX_JSON_DIGITS = 18
"""Digits of an integer: 64 bits hold so many."""
_BEGINS = re.compile(r'\A\s*\{\s*"schema":\s*"([^"\\]*)"')
"""Start of the files that rigkit writes: the schema is their first key."""


def parse_json(text: str) -> Any:
    """Return the value of a JSON text; raises ValueError, with the reason, for what is not strict JSON."""
    try:
        return json.loads(
            text,
            object_pairs_hook=_without_duplicates,
            parse_constant=_no_constant,
            parse_float=_finite_float,
            parse_int=_short_integer,
        )
    except RecursionError as error:
        raise ValueError("nested too deep") from error


def json_text(data: Any) -> str:
    """Return `data` as the content of a JSON file; raises ValueError for NaN and infinity."""
    return json.dumps(data, indent=1, allow_nan=False) + "\n"


def json_schema(path: str | Path) -> str | None:
    """Return the schema that a file states; None if it states none, is no JSON or cannot be read.

    The start of a damaged file of rigkit's is enough: its reader reports the damage.
    """
    try:
        text = read_text(path)
        if begins := _BEGINS.match(text):
            return begins[1]
        data = parse_json(text)
    except (InputError, ValueError):
        return None
    schema = data.get("schema") if isinstance(data, dict) else None
    return schema if isinstance(schema, str) else None


def read_json(path: str | Path, schema: str, keys: Collection[str], what: str, *, remedy: str) -> dict[str, Any]:
    """Return the outermost object of a file of `schema`; `what` names such a file in messages.

    Raises InputError, with the `remedy`, if the file does not exist, is no JSON, has another schema or a key that is
    not in `keys`.
    """
    try:
        data = parse_json(read_text(path, what))
    except ValueError as error:
        raise InputError(f"'{path}': not a {what} ({error}); {remedy}") from error
    found = data.get("schema") if isinstance(data, dict) else None
    if found != schema:
        kind = str(found).partition("/")[0]
        # Another file of rigkit is a mix-up: what made it would make it again.
        if kind.startswith("rigkit.") and kind != schema.partition("/")[0]:
            raise InputError(f"'{path}' is a {kind.removeprefix('rigkit.')[:60]} file; give a {what} instead")
        has = f"schema is {str(found)[:60]!r}" if found is not None else "it states no schema"
        raise InputError(f"'{path}': {has}, but a file with schema '{schema}' is needed here; {remedy}")
    unknown = sorted(set(data) - set(keys))
    if unknown:
        raise InputError(f"'{path}': unknown key {unknown[0][:60]!r}; known: {', '.join(sorted(keys))}")
    return dict(data)


def real(value: Any) -> float:
    """Return a number as a float; raises ValueError for other types, NaN, and more than MAX_NUMBER."""
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise ValueError(f"{str(value)[:40]!r} is not a number")
    if not abs(value) <= MAX_NUMBER:
        raise ValueError(f"{value:g} is larger than anything measured")
    return float(value)


def positive(value: Any) -> float:
    """Return a number of at least MIN_POSITIVE; raises ValueError for any other."""
    number = real(value)
    if not number >= MIN_POSITIVE:
        raise ValueError(f"{number:g} must be positive, at least {MIN_POSITIVE:g}")
    return number


def freedom(value: Any) -> float:
    """Return degrees of freedom; null is infinity. Raises ValueError below one."""
    if value is None:
        return math.inf
    if not (number := real(value)) >= 1.0:
        raise ValueError(f"{number:g} degrees of freedom; there are one or more")
    return number


def reals(value: Any, *, nullable: bool = False) -> FloatArray:
    """Return nested lists of numbers as an array, with null as NaN if `nullable`; raises ValueError like `real`."""
    array = np.array(value)
    if array.dtype.kind not in "iuf":
        if not nullable or any(one is not None and type(one) not in (int, float) for one in array.flat):
            raise ValueError("something among the numbers is none")
        array = np.array(value, dtype=np.float64)
    array = array.astype(np.float64)
    if (np.abs(array) > MAX_NUMBER).any():
        raise ValueError(f"{np.nanmax(np.abs(array)):g} is larger than anything measured")
    return array


def integer(value: Any) -> int:
    """Return an integer; raises ValueError for anything else, such as 640.5 and true."""
    number = real(value)
    if number != math.floor(number):
        raise ValueError(f"{value} is not a whole number")
    return int(number)


def _without_duplicates(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    out = dict(pairs)
    if len(out) < len(pairs):
        ((key, _),) = Counter(key for key, _ in pairs).most_common(1)
        raise ValueError(f"key {key[:60]!r} is there twice")
    return out


def _no_constant(word: str) -> float:
    raise ValueError(f"{word} is no number of JSON")


def _finite_float(text: str) -> float:
    value = float(text)
    if not math.isfinite(value):
        raise ValueError(f"{text[:40]} is too large")
    return value


def _short_integer(text: str) -> int:
    if len(text) > MAX_JSON_DIGITS:
        raise ValueError(f"a number of {len(text)} digits")
    return int(text)
