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
