"""The perspective camera without distortion: the target of rectification and the camera of virtual views."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, Self

import numpy as np

from rigkit.cameras.base import RadialCurve
from rigkit.cameras.radial import FocalCamera, ScaleDerivatives
from rigkit.core.arrays import BoolArray, FloatArray, Mat3


def camera_matrix(fx: float, fy: float, cx: float, cy: float) -> Mat3:
    """Return K = [[fx, 0, cx], [0, fy, cy], [0, 0, 1]]."""
    return np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])


@dataclass(frozen=True, eq=False, slots=True, repr=False)
class Pinhole(FocalCamera):
    """u = fx x/z + cx, v = fy y/z + cy; points with z <= 0 are not seen.

    Parameters are fx, fy, cx, cy in px.
    """

    model: ClassVar[str] = "pinhole"

    @classmethod
    def from_radial_curve(cls, size_px: tuple[int, int], curve: RadialCurve, *, order: int | None = None) -> Self:
        theta, radius = curve.below(np.pi / 2, cls.model)
        tangent = np.tan(theta)
        focal = float(tangent @ radius / (tangent @ tangent))
        return cls(size_px, np.array([focal, focal, *curve.centre_px]))

    @property
    def K(self) -> Mat3:
        """The camera matrix."""
        return camera_matrix(*self.parameters)

    @property
    def max_angle_rad(self) -> float:
        return float(np.pi / 2)

    def _scale(self, r2: FloatArray, z: FloatArray) -> tuple[FloatArray, BoolArray]:
        return 1.0 / z, (z > 0.0) & (r2 + z < np.inf)

    def _scale_derivatives(self, r2: FloatArray, z: FloatArray, shape: bool) -> ScaleDerivatives:
        scale, valid = self._scale(r2, z)
        return ScaleDerivatives(scale, valid, np.zeros_like(scale), -scale * scale, ())

    def _profile(self, radius2: FloatArray) -> tuple[FloatArray, FloatArray, BoolArray]:
        cosine = 1.0 / np.sqrt(1.0 + radius2)
        return cosine, cosine, np.isfinite(radius2)
