"""Validation of documents with the published schemas."""

from __future__ import annotations

import functools
from typing import Any

import jsonschema

from rigkit.io.schema import SCHEMAS

FREE = ("frames", "check")
"""Documents without a published schema: the record of frames, and requests to a coach's page."""


@functools.cache
def validator(name: str) -> jsonschema.Draft202012Validator:
    return jsonschema.Draft202012Validator(SCHEMAS[name])


def faults(document: Any) -> list[str]:
    """Errors of a document by the schema that it names; [] for one that names none."""
    schema = document.get("schema", "") if isinstance(document, dict) else ""
    if not str(schema).startswith("rigkit."):
        return []
    name = str(schema).removeprefix("rigkit.").partition("/")[0]
    if name in FREE:
        return []
    if name not in SCHEMAS:
        return [f"no schema is published for {schema}"]
    return [
        f"{schema} {'.'.join(map(str, e.absolute_path))}: {e.message[:200]}"
        for e in validator(name).iter_errors(document)
    ]
