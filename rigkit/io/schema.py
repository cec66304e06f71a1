"""JSON Schemas (draft 2020-12) of every file that rigkit reads or writes, by the name in its `schema` key."""

from __future__ import annotations

import json
from collections.abc import Iterator

from rigkit.core.errors import InputError
from rigkit.io.boards.board_file import BOARD_FILE
from rigkit.io.calibrations.schema_calibration import BOARD_RIG_FILE, CALIBRATION_FILE, CORNERS_FILE, RIG_FILE
from rigkit.io.disk.schema_builders import ANY_OF, Schema
from rigkit.io.manifests.manifest import DATASET_FILE
from rigkit.io.manifests.public_set import PUBLIC_FILE
from rigkit.io.manifests.session import SESSION_FILE
from rigkit.io.manifests.study_file import STUDY_FILE
from rigkit.io.schema_results import RESULT_FILES

_OF_PEOPLE = (BOARD_FILE, DATASET_FILE, PUBLIC_FILE, SESSION_FILE, STUDY_FILE)
_OF_CALIBRATIONS = (BOARD_RIG_FILE, CALIBRATION_FILE, CORNERS_FILE, RIG_FILE)
SCHEMAS: dict[str, Schema] = {
    str(schema["properties"]["schema"]["const"]).removeprefix("rigkit.").partition("/")[0]: schema
    for schema in (*_OF_PEOPLE, *_OF_CALIBRATIONS, *RESULT_FILES)
}
"""Schemas by name, such as "session" or "calibration"."""
_KIND_WORDS = {"string": "text", "object": "table", "boolean": "true or false", "integer": "whole number"}


def schema_named(name: str) -> Schema:
    """Return the schema of this name; raises InputError that lists the known ones."""
    if name not in SCHEMAS:
        raise InputError(f"no file is called '{name}'; there are {', '.join(SCHEMAS)}")
    return SCHEMAS[name]


def schema_text(name: str) -> str:
    """Return the schema as the content of a file."""
    return json.dumps(schema_named(name), indent=1, ensure_ascii=False) + "\n"


def key_rows(schema: Schema, prefix: str = "") -> Iterator[tuple[str, str, str]]:
    """Yield (key, type, description) of every key of a schema; `prefix` is that of inner objects."""
    required = schema.get("required", [])
    for key, own in schema["properties"].items():
        if key == "schema":
            continue
        words = own.get("description", "")
        yield f"{prefix}{key}", _kind(own), words if key in required else f"{words} (optional)".strip()
        inner = _inner(own)
        if inner is not None:
            yield from key_rows(inner, f"{prefix}{key}{'[]' if own.get('type') == 'array' else ''}.")


def _inner(schema: Schema) -> Schema | None:
    """Return the object schema that `schema` is, or is a list or choice of; None if there is none."""
    if "properties" in schema:
        return schema
    for one in (schema.get("items"), schema.get("additionalProperties"), *schema.get(ANY_OF, ())):
        found = _inner(one) if isinstance(one, dict) else None
        if found is not None:
            return found
    return None


def _kind(schema: Schema) -> str:
    """Return the type of a schema in words."""
    if "const" in schema or "enum" in schema:
        return ", ".join(f"`{value}`" for value in schema.get("enum", [schema.get("const")]))
    if ANY_OF in schema:
        return " or ".join(dict.fromkeys(filter(None, map(_kind, schema[ANY_OF]))))
    kind = schema.get("type", "")
    if kind == "array":
        return f"list of {_kind(schema['items'])}".replace("list of list of number", "matrix")
    return _KIND_WORDS.get(kind, str(kind))
