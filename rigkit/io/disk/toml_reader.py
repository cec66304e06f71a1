"""A strict reader for the TOML files that people write: the schema of a file is its reader.

A key that the schema does not have is an error, so a misspelt option cannot be silently ignored. Every message names
the file, the table and the key, and says what to write.
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
from rigkit.io.disk.reading import damage, fault_of_number, read_text, usable_path
from rigkit.io.disk.schema_words import ANY_OF, Schema

MAX_TOML_BYTES = 4_000_000
"""People write these files; the reader takes a second for each million."""
MAX_INTEGER = 10**12
MAX_SHOWN = 60
"""Characters of a value in a message."""
PLURALS = {"object": "tables", "string": "strings", "number": "numbers"}
COUNTED = ("no", "one", "two", "three")


def named_path(path: Path) -> Path:
    """Return the absolute path of a file under its own name: that of a link, not of what it leads to.

    Frames, views and reports go by names of images; a store of data (git-annex, DVC) links them to checksums.
    """
    return path.parent.resolve() / path.name


def relative_path(path: Path, folder: Path) -> str:
    """Return a path as a file in `folder` names it: from there, under its own name (`named_path`), whole where it is on
    another drive."""
    try:
        return Path(os.path.relpath(named_path(path), folder.resolve())).as_posix()
    except ValueError:
        return named_path(path).as_posix()


def toml_text(value: object) -> str:
    """Return a value as TOML writes it; raises InputError for words that UTF-8 cannot hold."""
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
    """One table of a file, which fits its schema: tables in it are `TomlTable`, lists tuples, numbers floats.

    `table[key]` is an error that says what to add where the key is missing, `table.get(key)` is not. `where` says which
    table it is, in the words of the file: "[[pairs]] 'fisheye-forward'".
    """

    def __init__(self, values: Mapping[str, Any], schema: Schema, path: Path, where: str = "") -> None:
        """Raise InputError for values that the schema does not have."""
        self._schema, self.path, self.where = schema, path, where
        self._values: dict[str, Any] = {}
        known, others = schema.get("properties", {}), schema.get("additionalProperties", True)
        self._require(schema.get("required", ()), values)
        if others is False:
            self.allow_only(known, values)
        for key, value in values.items():
            self._values[key] = self._checked(key, value, known.get(key, others))
        for key, beside in schema.get("dependentRequired", {}).items():
            self._require(beside if key in values else (), values)

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
        """Return the value; `default` where there is none."""
        return self._values.get(key, default)

    def error(self, message: str) -> InputError:
        """Return an error that starts with the file and the table."""
        place = f"{self.path}: {self.where}: " if self.where else f"{self.path}: "
        return InputError(place + message)

    @contextmanager
    def located(self, remedy: str = "") -> Iterator[None]:
        """Let complaints of the block start with the file and the table, and end with a remedy, unless they name the
        file already."""
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
                raise self.error(f"unknown key {_shown(key)}; {remedy}")

    def beside(self, name: str) -> Path:
        """Return the absolute path of `name`, taken from the folder of the file, as both are written."""
        with self.located():
            path = usable_path(self.path.parent / name)
            # Without links: a folder's ".." is where the link leads to.
            written = Path(os.path.abspath(path))
            return written if written.resolve() == path.resolve() else named_path(path)

    def _require(self, keys: Collection[str], values: Mapping[str, Any]) -> None:
        for key in keys:
            if key not in values:
                raise self.error(f"'{key}' is missing; add {_hint(key, self._schema['properties'].get(key, {}))}")

    def _checked(self, key: str, value: Any, schema: Schema) -> Any:
        """Return a value as the schema has it; raises InputError for one that it does not have."""
        if ANY_OF in schema:
            is_list = isinstance(value, list)
            return self._checked(key, value, next(s for s in _choices(schema) if (s["type"] == "array") == is_list))
        kind = schema.get("type", "string")
        fault = _fault(value, kind, schema)
        if fault is not None:
            raise self.error(f"'{key}' must {fault}, got {_shown(value)}; write {_hint(key, schema)}")
        if kind == "object":
            return TomlTable(value, schema, self.path, f"{self.where}, '{key}'" if self.where else f"[{key}]")
        if kind == "array":
            return self._list(key, value, schema)
        if value not in schema.get("enum", (value,)):
            raise self.error(f"'{key}' is {_shown(value)}, which is unknown; known: {', '.join(schema['enum'])}")
        if not re.match(schema.get("pattern", ""), str(value)):
            raise self.error(f"'{key}' is {_shown(value)}, which is not {schema['description']}")
        if schema.get("format") == "identifier":
            with self.located():
                check_identifier(value, f"'{key}'")
        return float(value) if kind == "number" else value

    def _list(self, key: str, value: list[Any], schema: Schema) -> tuple[Any, ...]:
        least, most, (items,) = schema.get("minItems", 0), schema.get("maxItems", len(value)), _choices(schema, "items")
        if not least <= len(value) <= most:
            count = f"{'' if most == least else 'at least '}{COUNTED[least]} {PLURALS[items.get('type', 'string')]}"
            fault = f"must be {count}, got {_shown(value)}" if value else "is empty"
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
    """Return the schemas that a schema is one of, or that of its items, with its own description and examples."""
    own = {name: value for name, value in schema.items() if name in ("description", "examples")}
    return [{**own, **one} for one in (schema[key] if key == ANY_OF else [schema[key]])]


def _fault(value: Any, kind: str, schema: Schema) -> str | None:
    """Return what a value of a kind must be, in words that follow "must"; None where it is that."""
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
    """Return what a person may write, as the file has it, and what it means."""
    if "enum" in schema:
        return f'{key} = "{schema["enum"][0]}" ({", ".join(schema["enum"])})'
    words = schema.get("description", "")
    shown = {"object": f"[{key}]", "array": f"[[{key}]]"}.get(schema.get("type", ""), "")
    if "examples" in schema:
        shown = f"{key} = {toml_text(schema['examples'][0])}"
    return (f"{shown} ({words})" if words else shown) if shown else words or f"{key} = ..."


def _shown(value: object) -> str:
    """Return the value on one line, cut where it is long."""
    try:
        text = ascii(value)
    except (ValueError, RecursionError):
        return "a number of thousands of digits, or something nested too deep"
    return text if len(text) <= MAX_SHOWN else f"{text[:MAX_SHOWN]}..."


def _is_word(value: object) -> bool:
    return isinstance(value, str) and value.isprintable()


def read_toml(path: str | Path, schema: Schema) -> TomlTable:
    """Return the file's outermost table, which fits the `schema` of a whole file.

    Raises InputError: no such file, not TOML (with the line), no schema, another schema or another version, values of
    another kind.
    """
    source, wanted = Path(path), schema["properties"]["schema"]["const"]
    text = read_text(source, max_bytes=MAX_TOML_BYTES)
    try:
        values = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        if text.lstrip().startswith("{"):
            raise InputError(f'{source}: JSON; a TOML file with schema = "{wanted}" is needed here') from error
        raise InputError(f"{source}: not valid TOML: {damage(error)}; correct that line") from error
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
            raise InputError(f"{source}: schema {_shown(found)} {words}")
        raise InputError(f'{source}: schema is {_shown(found)}, but a file with schema = "{wanted}" is needed here')
    return TomlTable(values, schema, source)
