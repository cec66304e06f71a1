"""Patterns by type. Adding one is one file and one line here (and one in `rigkit.detection.targets.registry`)."""

from __future__ import annotations

from rigkit.core.errors import InputError
from rigkit.core.patterns.aprilgrid import AprilGrid
from rigkit.core.patterns.base import Pattern
from rigkit.core.patterns.charuco import Charuco
from rigkit.core.patterns.chessboard import Chessboard
from rigkit.core.patterns.circles import Circles

PATTERNS: dict[str, type[Pattern]] = {cls.type: cls for cls in (Chessboard, Charuco, AprilGrid, Circles)}


def pattern_type(name: str) -> type[Pattern]:
    """Return the pattern called `name`; raises InputError that lists the known ones."""
    if name not in PATTERNS:
        raise InputError(f"type '{name}' is unknown; known: {', '.join(PATTERNS)}")
    return PATTERNS[name]
