"""Where boards can be held."""

from __future__ import annotations

import math
from dataclasses import dataclass

from rigkit.core.errors import InputError
from rigkit.core.printing import brief


@dataclass(frozen=True, slots=True)
class Reach:
    """Where boards can be held: within the depth of field, and within that of view of a lens.

    Attributes
    ----------
    nearest_mm : smallest distance of the board (default: any).
    farthest_mm : largest distance of the board (default: any).
    field_deg : full field of view of the lens, where boards can be seen (default: that of the model).
    """

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
