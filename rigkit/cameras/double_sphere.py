"""The double sphere camera.

Reference: V. Usenko, N. Demmel, D. Cremers, "The double sphere camera model", 3DV 2018, equations (40) to (52).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from rigkit.cameras.radial import FocalCamera, ScaleDerivatives
from rigkit.core.arrays import BoolArray, FloatArray
from rigkit.core.errors import InputError


@dataclass(frozen=True, eq=False, slots=True, repr=False)
class DoubleSphere(FocalCamera):
    """m = (x, y) / (alpha d2 + (1 - alpha) (xi d1 + z)), d1 = |X|, d2 = sqrt(x^2 + y^2 + (xi d1 + z)^2).

    Parameters are fx, fy, cx, cy in px, xi in (-1, 1), alpha in [0, 1].
    """

    model: ClassVar[str] = "double_sphere"
    closed_ranges: ClassVar[Mapping[str, tuple[float, float]]] = {"alpha": (0.0, 1.0)}
    shape_names: ClassVar[tuple[str, ...]] = ("xi", "alpha")
    shape_starts: ClassVar[tuple[tuple[float, ...], ...]] = (
        *((0.0, 0.1), (0.0, 0.5), (0.0, 0.6), (0.0, 0.7)),
        *((-0.2, 0.6), (0.3, 0.6)),
    )

    def _prepare(self) -> None:
        xi, alpha = self._shape()
        if not (-1.0 < xi < 1.0 and 0.0 <= alpha <= 1.0):
            raise InputError(
                f"double_sphere camera: xi = {xi:g}, alpha = {alpha:g}; need -1 < xi < 1 and 0 <= alpha <= 1"
            )

    def _shape(self) -> tuple[float, float]:
        xi, alpha = self.parameters[4:6].tolist()
        return xi, alpha

    def _edge(self) -> float:
        """The field of view is z > -edge * d1, equation (43)."""
        xi, alpha = self._shape()
        w1 = alpha / (1.0 - alpha) if alpha <= 0.5 else (1.0 - alpha) / alpha
        return float((w1 + xi) / np.sqrt(2.0 * w1 * xi + xi * xi + 1.0))

    @property
    def max_angle_rad(self) -> float:
        return float(np.arccos(np.clip(-self._edge(), -1.0, 1.0)))

    def _scale(self, r2: FloatArray, z: FloatArray) -> tuple[FloatArray, BoolArray]:
        xi, alpha = self._shape()
        d1 = np.sqrt(r2 + z * z)
        shifted = xi * d1 + z
        d2 = np.sqrt(r2 + shifted * shifted)
        return 1.0 / (alpha * d2 + (1.0 - alpha) * shifted), (z > -self._edge() * d1) & (d1 < np.inf)

    def _scale_derivatives(self, r2: FloatArray, z: FloatArray, shape: bool) -> ScaleDerivatives:
        xi, alpha = self._shape()
        d1 = np.sqrt(r2 + z * z)
        shifted = xi * d1 + z
        d2 = np.sqrt(r2 + shifted * shifted)
        scale, valid = self._scale(r2, z)
        minus = -scale * scale
        # d scale / d shifted, and the direct part of r in d2.
        by_shift = minus * (alpha * shifted / d2 + 1.0 - alpha)
        by_r = by_shift * (xi / d1) + minus * (alpha / d2)
        by_z = by_shift * (xi * z / d1 + 1.0)
        by_shape = (by_shift * d1, minus * (d2 - shifted)) if shape else ()
        return ScaleDerivatives(scale, valid, by_r, by_z, by_shape)

    def _profile(self, radius2: FloatArray) -> tuple[FloatArray, FloatArray, BoolArray]:
        xi, alpha = self._shape()
        under = 1.0 - (2.0 * alpha - 1.0) * radius2
        depth = (1.0 - alpha * alpha * radius2) / (alpha * np.sqrt(under) + 1.0 - alpha)
        total = depth * depth + radius2
        under2 = depth * depth + (1.0 - xi * xi) * radius2
        valid = (under >= 0.0) & (under2 >= 0.0) & np.isfinite(radius2)
        scale = (depth * xi + np.sqrt(under2)) / total
        return scale, scale * depth - xi, valid
