"""Changes of bytes, of structure and of values, for `fuzz.py`."""

from __future__ import annotations

import io
import json
import random
import re
import sqlite3
from collections.abc import Callable
from contextlib import closing
from typing import Any

import numpy as np

NUMBER = re.compile(r"(?<![\w.])[-+]?\d+(?:\.\d+)?(?:[eE][-+]?\d+)?(?![\w.])")
WORD = re.compile(r"\"[^\"\n]*\"|'[^'\n]*'|[A-Za-z_]{3,}")
VALUES = (
    "0", "-1", "1e999", "-1e300", "1e-320", "nan", "NaN", "inf", "-Infinity", "1e15", "2147483648", "0.5", "true",
    "null", '""', '"x"', "[]", "{}", "[[1, 2], [3]]", "-0.0", "9" * 30, "9" * 400, "9" * 5000, "1e5000", "0x10",
    "1_000", "1,5", "[1]", "abc", "1 2", "\u00b2", "1e160", "1e-160", "1e9",
)  # fmt: skip
"""In place of a number."""
WORDS = (
    '""', '" "', '"\\u0000"', '"a\\nb"', '"' + "x" * 300 + '"', '"../../.."', '"."', "[]", "1", "null", "true", "{}",
    '"=1+1"', '"<script>"', '"\u001b[31m"', '"\\ud800"', '"case"', '"*"', '"/proc/self/mem"', '"/dev/zero"', "nan",
    '"' + 140_000 * "x" + '"',
)  # fmt: skip
"""In place of a string or a key."""
ARGUMENTS = (
    "", " ", "0", "-1", "nan", "inf", "1e308", "1e-308", "9" * 400, "abc", ".", "..", "nothing.toml", "case",
    "image.png", "board.toml", "calibration.json", "rig.json", "x" * 300, "a\nb", "--json", "--force", "--help",
    "60000x60000", "1x1", "-5x3", "0x0", "/dev/zero", "out", "dataset.toml", "caf\u00e9", "\udcff", "[1]", "=1", "1=2",
)  # fmt: skip
"""In place of a word of a command; nothing that could be written outside of the case's folder."""
JSON_VALUES: tuple[Any, ...] = (
    None, True, -1, 0, 1, 3, 0.5, 100.0, 1e4, 1e9, 1e15, 1e160, 1e300, 10**400, 1e-4, 1e-9, 1e-160, 1e-320, "", "x",
    "nan", [], {}, [[]], [1, [2]], float("nan"), float("inf"), "a\nb", "\u0000", "\ud800", [None], {"a": 1},
)  # fmt: skip
SQL_VALUES: tuple[Any, ...] = (
    None, -1, 0, 1, 2, 2**62, -(2**62), 0.5, float("inf"), "", "x", "abc\udcff".encode("utf-8", "surrogateescape"), b"",
    b"\x00" * 16, b"\xff" * 1760, b"\x00\x00\xc0\x7f" * 440,
)  # fmt: skip
"""In place of a value of a database; the last are whole numbers beyond all, and floats that are none."""
MAX_DEPTH = 5000
"""Of the nests that are put in: deeper than Python's stack."""


def mutated(data: bytes, name: str, rng: random.Random) -> bytes:
    """Return the content of the file, changed once to three times, by bytes, structure or values."""
    ways: list[Callable[[bytes, random.Random], bytes]] = [_bytes, _values, _words, _lines, _values, _words]
    if name.endswith((".png", ".jpg", ".tif", ".bmp", ".webp")):
        ways = [_bytes]
    if name.endswith(".pgm"):
        ways = [_bytes, _values]
    if name.endswith(".json"):
        ways += [_json] * 4
    if name.endswith(".npz"):
        ways = [_bytes, _npz, _npz]
    if name.endswith(".db"):
        ways = [_bytes, _database, _database]
    for _ in range(rng.choice((1, 1, 1, 2, 3))):
        data = rng.choice(ways)(data, rng)
    return data


def mutated_arguments(words: list[str], rng: random.Random) -> list[str]:
    """Return the command with one to three words replaced, left out, doubled or put in; the verb stays."""
    for _ in range(rng.choice((1, 1, 2, 3))):
        at = rng.randrange(1, len(words)) if len(words) > 1 else 1
        way = rng.randrange(4)
        words = (
            words[:at]
            + {
                0: [rng.choice(ARGUMENTS), *words[at + 1 :]],
                1: words[at + 1 :],
                2: [*words[at : at + 1], *words[at:]],
                3: [rng.choice(ARGUMENTS), *words[at:]],
            }[way]
        )
    return words


def _bytes(data: bytes, rng: random.Random) -> bytes:
    out = bytearray(data)
    # Heads hold most of what can go wrong.
    reach = min(len(out), 200) if rng.random() < 0.5 else len(out)
    at = rng.randrange(max(reach, 1))
    size = rng.choice((1, 2, 4, 16, 256))
    way = rng.randrange(6)
    if way == 0 and out:
        out[at] = rng.randrange(256)
    elif way == 1:
        out[at : at + size] = bytes(rng.choice((0, 255, 127, 128)) for _ in range(size))
    elif way == 2:
        del out[at : at + size]
    elif way == 3:
        out[at:at] = rng.randbytes(size)
    elif way == 4:
        del out[at:]
    else:
        out[at:at] = out[at : at + size] * rng.choice((1, 100))
    return bytes(out)


def _replaced(data: bytes, pattern: re.Pattern[str], new: str, rng: random.Random) -> bytes:
    text = data.decode("latin-1")
    found = list(pattern.finditer(text))
    if not found:
        return _bytes(data, rng)
    # Half of the changes go to the first twenty places: long tables would take them all.
    hit = rng.choice(found[:20] if rng.random() < 0.5 else found)
    return (text[: hit.start()].encode("latin-1") + new.encode("utf-8", "replace")) + text[hit.end() :].encode(
        "latin-1"
    )


def _values(data: bytes, rng: random.Random) -> bytes:
    new = rng.choice(VALUES)
    if rng.random() < 0.1:
        depth = rng.randrange(100, MAX_DEPTH)
        new = "[" * depth + "]" * depth
    return _replaced(data, NUMBER, new, rng)


def _words(data: bytes, rng: random.Random) -> bytes:
    return _replaced(data, WORD, rng.choice(WORDS), rng)


def _lines(data: bytes, rng: random.Random) -> bytes:
    lines = data.split(b"\n")
    at, other = rng.randrange(len(lines)), rng.randrange(len(lines))
    way = rng.randrange(6)
    if way == 0:
        del lines[at]
    elif way == 1:
        lines.insert(other, lines[at])
    elif way == 2:
        lines[at], lines[other] = lines[other], lines[at]
    elif way == 3:
        lines[at] = b"  " + lines[at]
    elif way == 4:
        lines[at] = lines[at].replace(b" ", rng.choice((b"\t", b"", b"  ", b"\r")))
    else:
        lines[at] = lines[at][: rng.randrange(len(lines[at]) + 1)]
    return b"\n".join(lines)


def _json(data: bytes, rng: random.Random) -> bytes:
    try:
        return _changed_tree(json.loads(data), rng)
    except (ValueError, TypeError, RecursionError, OverflowError):
        # A change before this one left no JSON, or one that Python's own writer does not take.
        return _bytes(data, rng)


def _changed_tree(tree: Any, rng: random.Random) -> bytes:
    places: dict[tuple[str, ...], list[tuple[Any, Any]]] = {}
    _collect(tree, (), places)
    if not places:
        raise ValueError("nothing in it")
    # By what a value is, then by which of them: long tables would take them all.
    holder, key = rng.choice(places[rng.choice(sorted(places))])
    way = rng.randrange(7)
    if way == 0:
        del holder[key]
    elif way == 1:
        holder[key] = [holder[key]]
    elif way == 2 and isinstance(holder, list):
        holder.append(holder[key])
    elif way == 3 and isinstance(holder, dict):
        holder[rng.choice(("", "x", "schema", "name"))] = holder.pop(key)
    elif way == 4:
        holder[key] = _scaled(holder[key], rng.choice((0.0, -1.0, 1e-9, 1e-3, 1e3, 1e9)))
    else:
        holder[key] = rng.choice(JSON_VALUES)
    return json.dumps(tree).encode()


def _collect(node: Any, path: tuple[str, ...], places: dict[tuple[str, ...], list[tuple[Any, Any]]]) -> None:
    """Note in `places` where each value stands, by the keys that lead to it; entries of a list are alike."""
    for key in node if isinstance(node, dict) else range(len(node)):
        here = (*path, key if isinstance(key, str) else "*")
        places.setdefault(here, []).append((node, key))
        if isinstance(node[key], dict | list):
            _collect(node[key], here, places)


def _scaled(value: Any, factor: float) -> Any:
    """Return the value with every number in it multiplied."""
    if isinstance(value, list):
        return [_scaled(one, factor) for one in value]
    if isinstance(value, dict):
        return {key: _scaled(one, factor) for key, one in value.items()}
    return value * factor if isinstance(value, int | float) and not isinstance(value, bool) else value


def _npz(data: bytes, rng: random.Random) -> bytes:
    """Return the archive with one array replaced, renamed or left out."""
    try:
        with np.load(io.BytesIO(data)) as archive:
            arrays: dict[str, Any] = {name: archive[name] for name in archive.files}
    except Exception:
        return _bytes(data, rng)
    if not arrays:
        return _bytes(data, rng)
    name = rng.choice(sorted(arrays))
    value = arrays[name]
    arrays[name] = rng.choice(strange_arrays(np.atleast_1d(value)))
    if rng.random() < 0.2:
        arrays[rng.choice(("x", "A21", "pixels1", "sigma_px"))] = arrays.pop(name)
    stream = io.BytesIO()
    np.savez(stream, **arrays)
    return stream.getvalue()


def _database(data: bytes, rng: random.Random) -> bytes:
    """Return the SQLite database with one value, table or column changed."""
    with closing(sqlite3.connect(":memory:")) as database:
        database.deserialize(data)
        try:
            names = [name for (name,) in database.execute("SELECT name FROM sqlite_master WHERE type = 'table'")]
            table = rng.choice(names)
            columns = [row[1] for row in database.execute(f"PRAGMA table_info({table})")]
            column, way = rng.choice(columns), rng.randrange(6)
            if way == 0:
                database.execute(f"DROP TABLE {table}")
            elif way == 1:
                database.execute(f"ALTER TABLE {table} RENAME COLUMN {column} TO x")
            elif way == 2:
                database.execute(f"INSERT INTO {table} SELECT * FROM {table} LIMIT 1")
            else:
                row = rng.choice(["1", "rowid = 1"])
                database.execute(f"UPDATE {table} SET {column} = ? WHERE {row}", (rng.choice(SQL_VALUES),))
            database.commit()
        except (sqlite3.Error, IndexError):
            return _bytes(data, rng)
        return database.serialize()


def strange_arrays(value: Any) -> list[Any]:
    """Return arrays in the place of `value`: of other shapes and types, and with values that are no numbers."""
    a = np.asarray(value, dtype=float)
    spoiled = []
    for strange in (np.nan, np.inf, -np.inf, 1e300, -1e160, 1e-320, 0.0):
        one = a.copy()
        if one.size:
            one.flat[one.size // 2] = strange
        spoiled.append(one)
    return [
        *spoiled, a[..., None], a.ravel(), a[:0], np.zeros(()), np.zeros_like(a), -a, a * 1e300, a.astype(complex),
        a.astype("<U8"), a > 0, a.astype("f2"), np.full(a.shape, np.nan), np.zeros((3, 7)), np.repeat(a[:1], 2, 0)
        if a.ndim else a, a.T, a[::-1], np.round(a).astype("u1"), np.full_like(a, 5.0),
    ]  # fmt: skip
