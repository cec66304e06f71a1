"""Builders of JSON Schemas (draft 2020-12): objects with described keys, arrays, schemas of dataclasses."""

from __future__ import annotations

import dataclasses
import re
import types
from collections.abc import Mapping, Sequence
from inspect import cleandoc
from typing import Any, Union, get_args, get_origin, get_type_hints

Schema = dict[str, Any]
ANY_OF = "anyOf"
TEXT: Schema = {"type": "string"}
NUMBER: Schema = {"type": "number"}
POSITIVE: Schema = {"type": "number", "exclusiveMinimum": 0}
INTEGER: Schema = {"type": "integer", "minimum": 0}
BOOLEAN: Schema = {"type": "boolean"}
NAME: Schema = {"type": "string", "format": "identifier"}
"""A name: see `rigkit.core.identifiers`."""
COUNT: Schema = {"type": "integer", "minimum": 1}
PLAIN_KINDS: Mapping[type, Schema] = {str: TEXT, float: NUMBER, int: INTEGER, bool: BOOLEAN}


def described(schema: Schema, words: str, *examples: object) -> Schema:
    """Return the schema with a description and examples."""
    return {**schema, "description": words, **({"examples": list(examples)} if examples else {})}


def choice(*values: str) -> Schema:
    """Return the schema of a string that is one of `values`."""
    return {"enum": list(values)}


def nullable(schema: Schema) -> Schema:
    """Return the schema of a value that may be null."""
    return {ANY_OF: [schema, {"type": "null"}]}


def array(items: Schema, min_items: int = 0) -> Schema:
    """Return the schema of a list of at least `min_items`."""
    return {"type": "array", "items": items, **({"minItems": min_items} if min_items else {})}


def texts(min_items: int = 0, items: Schema = TEXT) -> Schema:
    """Return the schema of a list of at least `min_items` different strings."""
    return {**array(items, min_items), "uniqueItems": True}


def row(length: int, items: Schema = NUMBER) -> Schema:
    """Return the schema of a list of exactly `length` items."""
    return {"type": "array", "items": items, "minItems": length, "maxItems": length}


def matrix(rows: int | None = None, columns: int | None = None) -> Schema:
    """Return the schema of a matrix as a list of rows; None: any number of rows or columns."""
    inner = array(NUMBER) if columns is None else row(columns)
    return array(inner) if rows is None else row(rows, inner)


def obj(keys: Mapping[str, Schema], words: str = "") -> Schema:
    """Return the schema of an object with exactly these keys; names of optional keys end with "?"."""
    properties = {key.removesuffix("?"): schema for key, schema in keys.items()}
    required = [key for key in keys if not key.endswith("?")]
    out: Schema = {"type": "object", "properties": properties, "additionalProperties": False}
    if required:
        out["required"] = required
    return described(out, words) if words else out


def optional(keys: Mapping[str, Schema], *names: str) -> dict[str, Schema]:
    """Return the keys with those named, or all if none is named, marked as optional."""
    return {f"{key.removesuffix('?')}?" if not names or key in names else key: schema for key, schema in keys.items()}


def rows(keys: Mapping[str, Schema], words: str = "", *, min_items: int = 0) -> Schema:
    """Return the schema of a list of at least `min_items` objects."""
    out = array(obj(keys), min_items)
    return described(out, words) if words else out


def table(values: Schema) -> Schema:
    """Return the schema of an object with arbitrary keys."""
    return {"type": "object", "additionalProperties": values}


def file(schema: str, title: str, keys: Mapping[str, Schema]) -> Schema:
    """Return the schema of a whole file, whose key "schema" has this value."""
    own = obj({"schema": {"const": schema}, **keys})
    return {"$schema": "https://json-schema.org/draft/2020-12/schema", "title": title, **own}


def of_dataclass(cls: type, *, only: Sequence[str] = (), without: Sequence[str] = ()) -> Schema:
    """Return the schema of a dataclass as `asdict` gives it, with descriptions from its docstring.

    Numbers may be null, which stands for NaN in files.
    """
    hints, words = get_type_hints(cls), attributes_of(cls)
    properties = {}
    for field in dataclasses.fields(cls):
        if field.name not in without and (not only or field.name in only):
            one = _of_type(hints[field.name])
            properties[field.name] = described(one, words[field.name]) if field.name in words else one
    return obj(properties)


def _of_type(hint: Any) -> Schema:
    origin, inner = get_origin(hint), get_args(hint)
    if origin in (Union, types.UnionType):
        return nullable(_of_type(next(one for one in inner if one is not type(None))))
    if origin is tuple:
        return array(_of_type(inner[0]))
    if hint is float:
        return nullable(NUMBER)
    return PLAIN_KINDS.get(hint, {})


def attributes_of(cls: type) -> dict[str, str]:
    """Return the descriptions of the fields, also inherited ones, in the docstring's section "Attributes"."""
    lines = cleandoc(cls.__doc__ or "").partition("----------")[2].splitlines()
    out = {name: words for base in cls.__bases__ for name, words in attributes_of(base).items()}
    names: list[str] = []
    for line in lines:
        begins = re.match(r"^(\w+(?:, \w+)*) : (.*)$", line)
        if begins:
            names = begins[1].split(", ")
            out |= dict.fromkeys(names, begins[2].strip())
        elif line.startswith("    ") and names:
            out |= {name: f"{out[name]} {line.strip()}" for name in names}
    return out
