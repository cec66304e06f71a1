"""A strict reader for the TOML files that people write.

Every key is asked for by name; whatever was not asked for is an error, so a misspelt option cannot be silently ignored.
Every message names the file, the table and the key, and says what to write.
"""

from __future__ import annotations

import difflib
import json
import os
import tomllib
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from rigkit.core.errors import InputError
from rigkit.core.identifiers import check_identifier
from rigkit.io.numbers import fault_of_number
from rigkit.io.reading import read_text, usable_path

MAX_TOML_BYTES = 4_000_000
"""People write these files; the reader takes a second for each million."""
MAX_INTEGER = 10**12
MAX_SHOWN = 60
"""Characters of a value in a message."""


def _shown(value: object) -> str:
    """Return the value on one line, cut where it is long."""
    try:
        text = ascii(value)
    except (ValueError, RecursionError):
        return "a number of thousands of digits, or something nested too deep"
    return text if len(text) <= MAX_SHOWN else f"{text[:MAX_SHOWN]}..."


def _one_line(error: Exception) -> str:
    return " ".join(str(error).split())[:200]


def _is_word(value: object) -> bool:
    return isinstance(value, str) and value.isprintable()


def named_path(path: Path) -> Path:
    """Return the absolute path of a file under its own name: that of a link, not of what it leads to.

    Frames, views and reports go by names of images; a store of data (git-annex, DVC) links them to checksums.
    """
    return path.parent.resolve() / path.name


def toml_text(text: str) -> str:
    """Return a basic string of TOML, which has the escapes of JSON; raises InputError for what UTF-8 cannot hold."""
    try:
        text.encode()
    except UnicodeEncodeError as error:
        raise InputError(f"{text!r}: a file of UTF-8 cannot hold this name; rename the file") from error
    return json.dumps(text, ensure_ascii=False)


def relative_path(path: Path, folder: Path) -> str:
    """Return a path as a file in `folder` names it: from there, under its own name (`named_path`), whole where it is on
    another drive."""
    try:
        return Path(os.path.relpath(named_path(path), folder.resolve())).as_posix()
    except ValueError:
        return named_path(path).as_posix()


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

    @contextmanager
    def located(self) -> Iterator[None]:
        """Let complaints of the block start with the file and the table."""
        try:
            yield
        except InputError as error:
            raise self.error(str(error)) from error

    def has(self, key: str) -> bool:
        """Say whether the key is there, and make it a known one."""
        if key not in self._known:
            self._known.append(key)
        return key in self._values

    def is_list(self, key: str) -> bool:
        """Say whether there is a list, for what may be one value or several."""
        return isinstance(self._values.get(key), list)

    def text(self, key: str, *, hint: str, choices: Sequence[str] = ()) -> str:
        """Return a required string; `hint` is what the error tells the person to add, written as in the file."""
        value = self._required(key, hint)
        if not isinstance(value, str) or not value.strip():
            raise self.error(f"'{key}' must be a string, got {_shown(value)}; write {hint}")
        if choices and value not in choices:
            raise self.error(f"'{key}' is {_shown(value)}, which is unknown; known: {', '.join(choices)}")
        return value

    def number(self, key: str, *, hint: str, positive: bool = True) -> float:
        """Return a required finite number (positive unless told)."""
        value = self._required(key, hint)
        fault = fault_of_number(value, positive=positive)
        if fault:
            raise self.error(f"'{key}' must be {fault}, got {_shown(value)}; write {hint}")
        return float(value)

    def integer(self, key: str, *, hint: str, at_least: int = 0) -> int:
        """Return a required whole number."""
        value = self._required(key, hint)
        if isinstance(value, bool) or not isinstance(value, int):
            raise self.error(f"'{key}' must be a whole number, got {_shown(value)}; write {hint}")
        if not at_least <= value <= MAX_INTEGER:
            limit = f"at least {at_least}" if value < at_least else f"at most {MAX_INTEGER}"
            raise self.error(f"'{key}' must be {limit}, got {_shown(value)}; write {hint}")
        return value

    def boolean(self, key: str, *, hint: str) -> bool:
        """Return a required true or false."""
        value = self._required(key, hint)
        if not isinstance(value, bool):
            raise self.error(f"'{key}' must be true or false, got {_shown(value)}; write {hint}")
        return value

    def texts(self, key: str, *, hint: str) -> tuple[str, ...]:
        """Return a required list of strings, all different."""
        value = self._required(key, hint)
        if not isinstance(value, list) or not all(isinstance(v, str) and v.strip() for v in value):
            raise self.error(f"'{key}' must be a list of strings, got {_shown(value)}; write {hint}")
        twice = sorted({v for v in value if value.count(v) > 1})
        if twice:
            raise self.error(f"'{key}' names {', '.join(map(repr, twice))} twice; remove one")
        return tuple(value)

    def numbers(self, key: str, *, hint: str) -> tuple[float, ...]:
        """Return a required list of finite numbers."""
        value = self._required(key, hint)
        if not isinstance(value, list):
            raise self.error(f"'{key}' must be a list of numbers, got {_shown(value)}; write {hint}")
        for number in value:
            fault = fault_of_number(number, positive=False)
            if fault:
                raise self.error(f"'{key}': every entry must be {fault}, got {_shown(number)}; write {hint}")
        return tuple(float(v) for v in value)

    def path_to(self, key: str, *, hint: str) -> Path:
        """Return a required path, taken from the folder of the file."""
        return self.beside(self.text(key, hint=hint))

    def beside(self, name: str) -> Path:
        """Return the absolute path of `name`, taken from the folder of the file, as both are written."""
        try:
            path = usable_path(self.path.parent / name)
            # Without links: a folder's ".." is where the link leads to.
            written = Path(os.path.abspath(path))
            return written if written.resolve() == path.resolve() else named_path(path)
        except InputError as error:
            raise self.error(str(error)) from error

    def identifier(self, key: str, *, hint: str) -> str:
        """Return a required string that something is called by: see `rigkit.core.identifiers`."""
        value = self.text(key, hint=hint)
        try:
            return check_identifier(value, f"'{key}'")
        except InputError as error:
            raise self.error(str(error)) from error

    def table(self, key: str, *, hint: str) -> TomlTable:
        """Return a required table."""
        value = self._required(key, hint)
        if not isinstance(value, dict):
            raise self.error(f"'{key}' must be a table, got {_shown(value)}; write {hint}")
        return TomlTable(value, self.path, f"{self.where}, '{key}'" if self.where else f"[{key}]")

    def tables(self, key: str, *, hint: str) -> tuple[TomlTable, ...]:
        """Return a required, non-empty list of tables; each is called by its id where it has one."""
        value = self._required(key, hint)
        if not isinstance(value, list) or not value or not all(isinstance(v, dict) for v in value):
            raise self.error(f"'{key}' must be a list of tables, got {_shown(value)}; write {hint}")
        prefix = f"{self.where}, '{key}'" if self.where else f"[[{key}]]"
        return tuple(
            TomlTable(v, self.path, prefix + (f" '{v['id'][:40]}'" if _is_word(v.get("id")) else f" number {i + 1}"))
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
                raise self.error(f"unknown key {_shown(key)}; {guess}known: {', '.join(self._known)}")

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
    text = read_text(source, max_bytes=MAX_TOML_BYTES)
    try:
        values = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise InputError(f"{source}: not valid TOML: {_one_line(error)}; correct that line") from error
    except (ValueError, RecursionError) as error:
        fault = "nested too deep" if isinstance(error, RecursionError) else "a number of thousands of digits"
        raise InputError(f"{source}: not readable TOML: {fault}; correct the file") from error
    table = TomlTable(values, source)
    found = table.text("schema", hint=f'schema = "{schema}" as the first line')
    if found != schema:
        name, _, version = schema.partition("/")
        if found.partition("/")[0] == name:
            raise table.error(f"schema {_shown(found)} is of another version; write {name}/{version}, or update rigkit")
        raise table.error(f'schema is {_shown(found)}, but a file with schema = "{schema}" is needed here')
    return table
