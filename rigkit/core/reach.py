"""Where boards can be held."""

from __future__ import annotations

import math
from dataclasses import dataclass

from rigkit.core.errors import InputError
from rigkit.core.printing import brief


@dataclass(frozen=True, slots=True)
class Reach:
    """Where boards can be held: between `nearest_mm` and `farthest_mm` from the camera, the depth of field, and within
    `field_deg` of a lens whose image does not fill the sensor (None: the field of view of the model)."""

    nearest_mm: float = 0.0
    farthest_mm: float = math.inf
    field_deg: float | None = None

    __repr__ = brief

    def __post_init__(self) -> None:
        """Raise InputError for impossible distances or fields of view."""
        if not 0.0 <= self.nearest_mm < self.farthest_mm:
            raise InputError(f"boards held from {self.nearest_mm:g} to {self.farthest_mm:g} mm: give the nearer first")
        if self.field_deg is not None and not 0.0 < self.field_deg <= 360.0:
            raise InputError(f"a lens that sees {self.field_deg:g} degrees: give its full angle, up to 360")
