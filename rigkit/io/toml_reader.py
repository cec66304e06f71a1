"""A strict reader for the TOML files that people write.

Every key is asked for by name; whatever was not asked for is an error, so a misspelt option cannot be silently ignored.
Every message names the file, the table and the key, and says what to write.
"""

from __future__ import annotations

import difflib
import math
import tomllib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from rigkit.core.errors import InputError
from rigkit.io.text import read_text

__all__ = ["TomlTable", "named_path", "read_toml"]


def named_path(path: Path) -> Path:
    """Return the absolute path of a file under its own name: that of a link, not of what it leads to.

    Frames, views and reports go by names of images; a store of data (git-annex, DVC) links them to checksums.
    """
    return path.parent.resolve() / path.name


class TomlTable:
    """One table of a file. Ask for its keys, then call `done()`.

    `where` says which table it is, in the words of the file: "[[pairs]] 'fisheye-forward'".
    """

    def __init__(self, values: dict[str, Any], path: Path, where: str = "") -> None:
        self._values = values
        self._known: list[str] = []
        self.path = path
        self.where = where

    def error(self, message: str) -> InputError:
        """Return an error that starts with the file and the table."""
        place = f"{self.path}: {self.where}: " if self.where else f"{self.path}: "
        return InputError(place + message)

    def has(self, key: str) -> bool:
        """Say whether the key is there, and make it a known one."""
        if key not in self._known:
            self._known.append(key)
        return key in self._values

    def text(self, key: str, *, hint: str, choices: Sequence[str] = ()) -> str:
        """Return a required string; `hint` is what the error tells the person to add, written as in the file."""
        value = self._required(key, hint)
        if not isinstance(value, str) or not value.strip():
            raise self.error(f"'{key}' must be a string, got {value!r}; write {hint}")
        if choices and value not in choices:
            raise self.error(f"'{key}' is '{value}', which is unknown; known: {', '.join(choices)}")
        return value

    def number(self, key: str, *, hint: str, positive: bool = True) -> float:
        """Return a required finite number (positive unless told)."""
        value = self._required(key, hint)
        if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
            raise self.error(f"'{key}' must be a number, got {value!r}; write {hint}")
        if positive and value <= 0:
            raise self.error(f"'{key}' must be positive, got {value}; write {hint}")
        return float(value)

    def integer(self, key: str, *, hint: str, at_least: int = 0) -> int:
        """Return a required whole number."""
        value = self._required(key, hint)
        if isinstance(value, bool) or not isinstance(value, int):
            raise self.error(f"'{key}' must be a whole number, got {value!r}; write {hint}")
        if value < at_least:
            raise self.error(f"'{key}' must be at least {at_least}, got {value}; write {hint}")
        return value

    def boolean(self, key: str, *, hint: str) -> bool:
        """Return a required true or false."""
        value = self._required(key, hint)
        if not isinstance(value, bool):
            raise self.error(f"'{key}' must be true or false, got {value!r}; write {hint}")
        return value

    def texts(self, key: str, *, hint: str) -> tuple[str, ...]:
        """Return a required list of strings, all different."""
        value = self._required(key, hint)
        if not isinstance(value, list) or not all(isinstance(v, str) and v.strip() for v in value):
            raise self.error(f"'{key}' must be a list of strings, got {value!r}; write {hint}")
        twice = sorted({v for v in value if value.count(v) > 1})
        if twice:
            raise self.error(f"'{key}' names {', '.join(map(repr, twice))} twice; remove one")
        return tuple(value)

    def numbers(self, key: str, *, hint: str) -> tuple[float, ...]:
        """Return a required list of finite numbers."""
        value = self._required(key, hint)
        fits = isinstance(value, list) and all(
            isinstance(v, int | float) and not isinstance(v, bool) and math.isfinite(v) for v in value
        )
        if not fits:
            raise self.error(f"'{key}' must be a list of numbers, got {value!r}; write {hint}")
        return tuple(float(v) for v in value)

    def path_to(self, key: str, *, hint: str) -> Path:
        """Return a required path, taken from the folder of the file."""
        return named_path(self.path.parent / self.text(key, hint=hint))

    def table(self, key: str, *, hint: str) -> TomlTable:
        """Return a required table."""
        value = self._required(key, hint)
        if not isinstance(value, dict):
            raise self.error(f"'{key}' must be a table, got {value!r}; write {hint}")
        return TomlTable(value, self.path, f"{self.where}, '{key}'" if self.where else f"[{key}]")

    def tables(self, key: str, *, hint: str) -> tuple[TomlTable, ...]:
        """Return a required, non-empty list of tables; each is called by its id where it has one."""
        value = self._required(key, hint)
        if not isinstance(value, list) or not value or not all(isinstance(v, dict) for v in value):
            raise self.error(f"'{key}' must be a list of tables, got {value!r}; write {hint}")
        prefix = f"{self.where}, '{key}'" if self.where else f"[[{key}]]"
        return tuple(
            TomlTable(v, self.path, f"{prefix} '{v['id']}'" if "id" in v else f"{prefix} number {i + 1}")
            for i, v in enumerate(value)
        )

    def names(self) -> tuple[str, ...]:
        """Return all keys there are and make them known: for tables whose keys are names that the person chose."""
        for key in self._values:
            self.has(key)
        return tuple(self._values)

    def done(self) -> None:
        """Raise InputError if the table has a key that nobody asked for."""
        for key in self._values:
            if key not in self._known:
                close = difflib.get_close_matches(key, self._known, n=1)
                guess = f"did you mean '{close[0]}'? " if close else ""
                raise self.error(f"unknown key '{key}'; {guess}known: {', '.join(self._known)}")

    def _required(self, key: str, hint: str) -> Any:
        if not self.has(key):
            raise self.error(f"'{key}' is missing; add {hint}")
        return self._values[key]


def read_toml(path: str | Path, schema: str) -> TomlTable:
    """Return the file's outermost table, its schema checked.

    Parameters
    ----------
    path : file.
    schema : name and version, such as "rigkit.dataset/1".

    Raises
    ------
    InputError
        No such file, not TOML (with the line), no schema, another schema or another version.
    """
    source = Path(path)
    text = read_text(source)
    try:
        values = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise InputError(f"{source}: not valid TOML: {error}; correct that line") from error
    table = TomlTable(values, source)
    found = table.text("schema", hint=f'schema = "{schema}" as the first line')
    if found != schema:
        name, _, version = schema.partition("/")
        if found.partition("/")[0] == name:
            raise table.error(f"schema '{found}' is of another version; this rigkit reads version {version}")
        raise table.error(f"schema is '{found}', but a file with schema = \"{schema}\" is needed here")
    return table
