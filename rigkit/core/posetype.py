"""How the two cameras of a pair stand to each other."""

from __future__ import annotations

from enum import StrEnum

from rigkit.core.errors import InputError


class PoseType(StrEnum):
    """The relative pose that a person declares for a pair.

    GENERAL: anything. PLANAR: rotation about the vertical camera axis, translation in the horizontal plane.
    STANDARD: no rotation, translation along x. FORWARD: no rotation, translation along z.
    AUTO: let the data decide.
    """

    GENERAL = "general"
    PLANAR = "planar"
    STANDARD = "standard"
    FORWARD = "forward"
    AUTO = "auto"

    @classmethod
    def _missing_(cls, value: object) -> None:
        raise InputError(f"pose type '{value}' is unknown; known: {', '.join(cls)}")


def axis_of(kind: str) -> int | None:
    """Return along which camera axis a pose type without rotation moves, 0 for x and 2 for z; None for any other."""
    return {"standard": 0, "forward": 2}.get(kind)
