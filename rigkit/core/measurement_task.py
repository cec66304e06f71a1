"""The task of a measurement: the quantity, its size, and the distance."""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import StrEnum

from rigkit.core.errors import InputError


class Quantity(StrEnum):
    """The measured quantity."""

    LENGTH = "length"
    DEPTH = "depth"
    PLANE = "plane"
    ANGLE = "angle"


@dataclass(frozen=True, slots=True, kw_only=True)
class Task:
    """A measurement task.

    Attributes
    ----------
    quantity : a length perpendicular to the line of sight (the worse of vertical and horizontal), a depth along it, the
        flatness of a plane of `size_mm` x `size_mm` that faces the camera (its worst point), or the angle between a
        horizontal and a vertical edge of `size_mm`.
    size_mm : the length, or the sides.
    distance_mm : from the first camera to the middle of the measured object.
    distance_sigma_mm : standard deviation of that distance; one camera measures lengths with it.
    confidence : probability that the error is within the bound.
    """

    quantity: Quantity
    size_mm: float
    distance_mm: float
    distance_sigma_mm: float = 0.0
    confidence: float = 0.95

    def __post_init__(self) -> None:
        for name, value in (("size", self.size_mm), ("distance", self.distance_mm)):
            if not (math.isfinite(value) and value > 0.0):
                raise InputError(f"certificate: the {name} must be positive, got {value} mm")
        if not (math.isfinite(self.distance_sigma_mm) and self.distance_sigma_mm >= 0.0):
            raise InputError(f"certificate: the distance cannot be known to {self.distance_sigma_mm} mm")
        if not 0.0 < self.confidence < 1.0:
            raise InputError(
                f"certificate: the confidence must lie between 0 and 100 %, got {100.0 * self.confidence:g} %"
            )

    @property
    def unit(self) -> str:
        """Unit of the error: "mm", or "deg" for angles."""
        return "deg" if self.quantity is Quantity.ANGLE else "mm"
