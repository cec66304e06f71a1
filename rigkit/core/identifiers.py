"""What boards, cameras, pairs and data sets may be called: names go into folders, tables, pages and files' headers."""

from __future__ import annotations

import re
from collections.abc import Collection

from rigkit.core.errors import InputError

MAX_IDENTIFIER = 60
"""Characters; file systems take 255 bytes, of which a letter may need four."""
IDENTIFIER = re.compile(r"\w([\w .+()-]*[\w.+()-])?")


def last_number(name: str) -> str:
    """Return the last number in a name, without leading zeros; the name itself where it has none."""
    numbers = re.findall(r"\d+", name)
    return str(int(numbers[-1])) if numbers else name


def known_name(name: str, known: Collection[str]) -> str | None:
    """Return the one of `known` that is this name, if need be apart from its case, and with l for left and r for right;
    None if there is none, or several.

    >>> known_name("L", ["left", "right"]), known_name("top", ["left", "right"])
    ('left', None)
    """
    if name in known:
        return name
    alike = [one for one in known if _side(one) == _side(name)]
    return alike[0] if len(alike) == 1 else None


def _side(name: str) -> str:
    return {"l": "left", "r": "right"}.get(name.lower(), name.lower())


def natural_key(name: str) -> list[tuple[int, str]]:
    """Return the key of natural sorting, in which numbers sort by value.

    >>> sorted(["b10", "b9", "a"], key=natural_key)
    ['a', 'b9', 'b10']
    """
    return [(int(part) if part.isdecimal() else -1, part) for part in re.split(r"(\d+)", name.lower())]


def is_identifier(name: str) -> bool:
    """Return whether `name` is a valid identifier: letters and digits of any script, '_', '-', '.', '+', parentheses
    and blanks inside; a letter, digit or '_' first."""
    return len(name) <= MAX_IDENTIFIER and IDENTIFIER.fullmatch(name) is not None and ".." not in name


def check_identifier(name: str, what: str) -> str:
    """Return `name` if `is_identifier`; else raises InputError, which calls it `what`."""
    if is_identifier(name):
        return name
    shown = ascii(name if len(name) <= MAX_IDENTIFIER else name[:MAX_IDENTIFIER] + "...")
    raise InputError(
        f"{what} {shown} is no name, which has no slashes: use at most {MAX_IDENTIFIER} letters, digits, '_', "
        "'-' and '.', with a letter or digit first"
    )
