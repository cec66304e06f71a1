"""A lens that stays as it is: poses and boards' shapes may be solved for beside it, but nothing of it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, Self

import numpy as np
from numpy.typing import ArrayLike

from rigkit.cameras.base import Camera, RadialCurve
from rigkit.core.arrays import BoolArray, FloatArray
from rigkit.core.errors import InputError


@dataclass(frozen=True, eq=False, slots=True, repr=False)
class HeldLens(Camera):
    """The camera `lens`, without a parameter."""

    lens: Camera

    model: ClassVar[str] = "held"

    @classmethod
    def of(cls, lens: Camera) -> HeldLens:
        """Return the lens, held."""
        return cls(lens.size_px, np.zeros(0), lens)

    @classmethod
    def from_radial_curve(cls, size_px: tuple[int, int], curve: RadialCurve, *, order: int | None = None) -> Self:
        raise InputError("a held lens is not made of a curve; it is one that is known")

    def parameter_names(self) -> tuple[str, ...]:
        return ()

    def with_parameters(self, parameters: ArrayLike) -> Self:
        return self

    @property
    def max_angle_rad(self) -> float:
        return self.lens.max_angle_rad

    def _project(self, x: FloatArray, y: FloatArray, z: FloatArray) -> tuple[FloatArray, FloatArray, BoolArray]:
        return self.lens._project(x, y, z)

    def _unproject(self, u: FloatArray, v: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray, BoolArray]:
        return self.lens._unproject(u, v)

    def _derivatives(
        self,
        x: FloatArray,
        y: FloatArray,
        z: FloatArray,
        d_pixels_d_point: FloatArray,
        d_pixels_d_parameters: FloatArray | None,
    ) -> tuple[FloatArray, FloatArray, BoolArray]:
        return self.lens._derivatives(x, y, z, d_pixels_d_point, None)
