"""A strict reader for the TOML files that people write, driven by their JSON Schemas.

An unknown key is an error, so that a misspelt option is not ignored. Every message names the file, the table and the
key, and says what to write.
"""

from __future__ import annotations

import difflib
import json
import os
import re
import tomllib
from collections.abc import Collection, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from rigkit.core.errors import InputError
from rigkit.core.identifiers import check_identifier
from rigkit.io.disk.reading import fault_of_number, on_one_line, read_text, usable_path
from rigkit.io.disk.schema_builders import ANY_OF, Schema

MAX_TOML_BYTES = 4_000_000
"""People write these files; the reader takes a second for each million."""
MAX_INTEGER = 10**12
MAX_SHOWN = 60
"""Characters of a value in a message."""
PLURALS = {"object": "tables", "string": "strings", "number": "numbers"}
COUNTED = ("no", "one", "two", "three")


def named_path(path: Path) -> Path:
    """Return the absolute path of a file; a link at its end is not resolved.

    Images are assigned to frames by their names; data stores (git-annex, DVC) link these names to checksums.
    """
    return path.parent.resolve() / path.name


def relative_path(path: Path, folder: Path) -> str:
    """Return a path relative to `folder`, as `named_path`; absolute if it is on another drive."""
    try:
        return Path(os.path.relpath(named_path(path), folder.resolve())).as_posix()
    except ValueError:
        return named_path(path).as_posix()


def toml_text(value: object) -> str:
    """Return a value as TOML; raises InputError for text that UTF-8 cannot encode."""
    if isinstance(value, Mapping):
        return "{ " + ", ".join(f"{key} = {toml_text(one)}" for key, one in value.items()) + " }"
    if isinstance(value, list | tuple):
        return f"[{', '.join(map(toml_text, value))}]"
    try:
        str(value).encode()
    except UnicodeEncodeError as error:
        raise InputError(f"{value!r}: a file of UTF-8 cannot hold this name; rename the file") from error
    # A basic string of TOML has the escapes of JSON.
    return json.dumps(value, ensure_ascii=False)


class TomlTable(Mapping[str, Any]):
    """A validated table of a file: tables in it are `TomlTable`, lists are tuples, numbers floats.

    `table[key]` of a missing key raises InputError that says what to add. `where` names the table in messages, such as
    "[[pairs]] 'fisheye-forward'".
    """

    def __init__(self, values: Mapping[str, Any], schema: Schema, path: Path, where: str = "") -> None:
        """Raise InputError for values that do not fit the schema."""
        self._schema, self.path, self.where = schema, path, where
        self._values: dict[str, Any] = {}
        known, others = schema.get("properties", {}), schema.get("additionalProperties", True)
        self._require(schema.get("required", ()), values)
        if others is False:
            self.allow_only(known, values)
        for key, value in values.items():
            self._values[key] = self._checked(key, value, known.get(key, others))
        for key, required in schema.get("dependentRequired", {}).items():
            self._require(required if key in values else (), values)

    def __getitem__(self, key: str) -> Any:
        self._require([key], self._values)
        return self._values[key]

    def __contains__(self, key: object) -> bool:
        return key in self._values

    def __iter__(self) -> Iterator[str]:
        return iter(self._values)

    def __len__(self) -> int:
        return len(self._values)

    def get(self, key: str, default: Any = None) -> Any:
        """Return the value, or `default`."""
        return self._values.get(key, default)

    def error(self, message: str) -> InputError:
        """Return an error that starts with the file and the table."""
        place = f"{self.path}: {self.where}: " if self.where else f"{self.path}: "
        return InputError(place + message)

    @contextmanager
    def located(self, remedy: str = "") -> Iterator[None]:
        """Prefix an InputError of the block with the file and the table, and append `remedy`, unless it names the file
        already."""
        try:
            yield
        except InputError as error:
            raise error if str(self.path) in str(error) else self.error(f"{error}{remedy}") from error

    def allow_only(self, known: Collection[str], values: Mapping[str, Any] | None = None) -> None:
        """Raise InputError if the table has a key that is not among the known ones."""
        for key in self._values if values is None else values:
            if key not in known:
                close = difflib.get_close_matches(key, known, n=1)
                remedy = f"did you mean '{close[0]}'?" if close else f"known: {', '.join(known)}"
                raise self.error(f"unknown key {_value_in_words(key)}; {remedy}")

    def path_of(self, name: str) -> Path:
        """Return the absolute path of `name`, relative to the folder of the file; links are not resolved."""
        with self.located():
            path = usable_path(self.path.parent / name)
            # abspath is wrong for ".." after a link to a folder.
            written = Path(os.path.abspath(path))
            return written if written.resolve() == path.resolve() else named_path(path)

    def _require(self, keys: Collection[str], values: Mapping[str, Any]) -> None:
        for key in keys:
            if key not in values:
                raise self.error(f"'{key}' is missing; add {_hint(key, self._schema['properties'].get(key, {}))}")

    def _checked(self, key: str, value: Any, schema: Schema) -> Any:
        """Return a value converted as the schema has it; raises InputError if it does not fit."""
        if ANY_OF in schema:
            is_list = isinstance(value, list)
            return self._checked(key, value, next(s for s in _choices(schema) if (s["type"] == "array") == is_list))
        kind = schema.get("type", "string")
        fault = _fault(value, kind, schema)
        if fault is not None:
            raise self.error(f"'{key}' must {fault}, got {_value_in_words(value)}; write {_hint(key, schema)}")
        if kind == "object":
            return TomlTable(value, schema, self.path, f"{self.where}, '{key}'" if self.where else f"[{key}]")
        if kind == "array":
            return self._list(key, value, schema)
        if value not in schema.get("enum", (value,)):
            raise self.error(
                f"'{key}' is {_value_in_words(value)}, which is unknown; known: {', '.join(schema['enum'])}"
            )
        if not re.match(schema.get("pattern", ""), str(value)):
            raise self.error(f"'{key}' is {_value_in_words(value)}, which is not {schema['description']}")
        if schema.get("format") == "identifier":
            with self.located():
                check_identifier(value, f"'{key}'")
        return float(value) if kind == "number" else value

    def _list(self, key: str, value: list[Any], schema: Schema) -> tuple[Any, ...]:
        least, most, (items,) = schema.get("minItems", 0), schema.get("maxItems", len(value)), _choices(schema, "items")
        if not least <= len(value) <= most:
            count = f"{'' if most == least else 'at least '}{COUNTED[least]} {PLURALS[items.get('type', 'string')]}"
            fault = f"must be {count}, got {_value_in_words(value)}" if value else "is empty"
            raise self.error(f"'{key}' {fault}; write {_hint(key, schema)}")
        if items.get("type") == "object":
            prefix = f"{self.where}, '{key}'" if self.where else f"[[{key}]]"
            names = [one.get("id") for one in value]
            called = [f"'{name[:40]}'" if _is_word(name) else f"number {k}" for k, name in enumerate(names, start=1)]
            return tuple(TomlTable(v, items, self.path, f"{prefix} {n}") for v, n in zip(value, called, strict=True))
        out = tuple(self._checked(key, one, items) for one in value)
        if twice := sorted({one for one in out if out.count(one) > 1}) if "uniqueItems" in schema else ():
            raise self.error(f"'{key}' names {', '.join(map(repr, twice))} twice; remove one")
        return out


def _choices(schema: Schema, key: str = ANY_OF) -> list[Schema]:
    """Return the alternatives of a schema, or the schema of its items, with its description and examples."""
    own = {name: value for name, value in schema.items() if name in ("description", "examples")}
    return [{**own, **one} for one in (schema[key] if key == ANY_OF else [schema[key]])]


def _fault(value: Any, kind: str, schema: Schema) -> str | None:
    """Return what a value must be, in words that follow "must"; None if it is valid."""
    if kind == "string":
        return None if isinstance(value, str) and value.strip() else "be a string"
    if kind == "boolean":
        return None if isinstance(value, bool) else "be true or false"
    if kind == "object":
        return None if isinstance(value, dict) else "be a table"
    if kind == "array":
        items = schema["items"].get("type", "string")
        whole = isinstance(value, list) and (bool(value) or items != "object")
        whole = whole and (items == "number" or not any(_fault(one, items, schema["items"]) for one in value))
        return None if whole else f"be a list of {PLURALS[items]}"
    least = schema.get("minimum")
    if kind == "number":
        fault = fault_of_number(value, positive="exclusiveMinimum" in schema)
        if fault is None and least is not None and value < least:
            return "not be negative"
        return fault and f"be {fault}"
    if isinstance(value, bool) or not isinstance(value, int):
        return "be a whole number"
    if least is not None and value < least:
        return f"be at least {least}"
    return f"be at most {MAX_INTEGER}" if value > MAX_INTEGER else None


def _hint(key: str, schema: Schema) -> str:
    """Return an example of a key as the file has it, with its meaning."""
    if "enum" in schema:
        return f'{key} = "{schema["enum"][0]}" ({", ".join(schema["enum"])})'
    words = schema.get("description", "")
    shown = {"object": f"[{key}]", "array": f"[[{key}]]"}.get(schema.get("type", ""), "")
    if "examples" in schema:
        shown = f"{key} = {toml_text(schema['examples'][0])}"
    return (f"{shown} ({words})" if words else shown) if shown else words or f"{key} = ..."


def _value_in_words(value: object) -> str:
    """Return a value on one line, truncated to MAX_SHOWN characters."""
    try:
        text = ascii(value)
    except (ValueError, RecursionError):
        return "a number of thousands of digits, or something nested too deep"
    return text if len(text) <= MAX_SHOWN else f"{text[:MAX_SHOWN]}..."


def _is_word(value: object) -> bool:
    return isinstance(value, str) and value.isprintable()


def read_toml(path: str | Path, schema: Schema) -> TomlTable:
    """Return the outermost table of a file, validated by its `schema`.

    Raises InputError: no such file, not TOML (with the line), another schema or version, or invalid values.
    """
    source, wanted = Path(path), schema["properties"]["schema"]["const"]
    text = read_text(source, max_bytes=MAX_TOML_BYTES)
    try:
        values = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        if text.lstrip().startswith("{"):
            raise InputError(f'{source}: JSON; a TOML file with schema = "{wanted}" is needed here') from error
        raise InputError(f"{source}: not valid TOML: {on_one_line(error)}; correct that line") from error
    except (ValueError, RecursionError) as error:
        fault = "nested too deep" if isinstance(error, RecursionError) else "a number of thousands of digits"
        raise InputError(f"{source}: not readable TOML: {fault}; correct the file") from error
    found = values.get("schema")
    if found is None:
        raise InputError(f"{source}: 'schema' is missing; add schema = {toml_text(wanted)} as the first line")
    if found != wanted:
        name, _, version = wanted.partition("/")
        if str(found).partition("/")[0] == name:
            words = f"is of another version; write {name}/{version}, or update rigkit"
            raise InputError(f"{source}: schema {_value_in_words(found)} {words}")
        raise InputError(
            f'{source}: schema is {_value_in_words(found)}, but a file with schema = "{wanted}" is needed here'
        )
    return TomlTable(values, schema, source)
