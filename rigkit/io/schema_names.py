"""The names of file formats, apart from their schemas, whose modules take most of a second to import."""

from __future__ import annotations

from rigkit.core.errors import InputError

SCHEMA_NAMES = (
    *("board", "dataset", "public", "session", "study"),
    *("board_rig", "calibration", "corners", "rig"),
    *("certificate", "crosscheck", "hand_eye", "history", "page", "study_result", "tables", "validation"),
)
"""Files that people write, calibrations, and other results, in the order of `rigkit.io.schema.SCHEMAS`."""


def require_schema(name: str) -> None:
    """Raise InputError, which lists the known ones, unless a file format has this name."""
    if name not in SCHEMA_NAMES:
        raise InputError(f"no file is called '{name}'; there are {', '.join(SCHEMA_NAMES)}")
