"""Types of the relative pose of a pair of cameras."""

from __future__ import annotations

from enum import StrEnum

from rigkit.core.errors import InputError


class PoseType(StrEnum):
    """Type of the relative pose, as declared for a pair.

    GENERAL: any. PLANAR: rotation about the vertical camera axis, translation in the horizontal plane.
    STANDARD: no rotation, translation along x. FORWARD: no rotation, translation along z.
    AUTO: chosen from the data.
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
    """Return the camera axis of the translation of a pose type without rotation, 0 for x and 2 for z; else None."""
    return {"standard": 0, "forward": 2}.get(kind)
