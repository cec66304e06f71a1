"""The enhanced unified camera.

Reference: B. Khomutenko, G. Garcia, P. Martinet, "An enhanced unified camera model", RA-L 2016; the domain of validity
from V. Usenko, N. Demmel, D. Cremers, "The double sphere camera model", 3DV 2018, section II.
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
class EUCM(FocalCamera):
    """m = (x, y) / (alpha d + (1 - alpha) z), d = sqrt(beta (x^2 + y^2) + z^2); u = fx m_x + cx, v = fy m_y + cy.

    Parameters are fx, fy, cx, cy in px, alpha in (0, 1), beta > 0. The field of view ends where the denominator
    vanishes (alpha <= 1/2) or where the radius stops growing.
    """

    model: ClassVar[str] = "eucm"
    closed_ranges: ClassVar[Mapping[str, tuple[float, float]]] = {"alpha": (0.0, 1.0)}
    shape_names: ClassVar[tuple[str, ...]] = ("alpha", "beta")
    shape_starts: ClassVar[tuple[tuple[float, ...], ...]] = ((0.1, 1.0), (0.5, 1.0), (0.6, 1.0), (0.7, 1.0))

    def _shape(self) -> tuple[float, float]:
        alpha, beta = self.parameters[4:6].tolist()
        return alpha, beta

    def _prepare(self) -> None:
        alpha, beta = self._shape()
        if not (0.0 <= alpha <= 1.0 and beta > 0.0):
            raise InputError(f"{self.model} camera: alpha = {alpha:g}, beta = {beta:g}; need 0 <= alpha <= 1, beta > 0")

    def _edge(self) -> float:
        """The field of view is z > -edge * d."""
        alpha, _ = self._shape()
        return alpha / (1.0 - alpha) if alpha <= 0.5 else (1.0 - alpha) / alpha

    @property
    def max_angle_rad(self) -> float:
        _, beta = self._shape()
        edge = self._edge()
        # z = -edge d with d^2 = beta r^2 + z^2.
        return float(np.arctan2(np.sqrt(max(1.0 - edge * edge, 0.0) / beta), -edge))

    def _scale(self, r2: FloatArray, z: FloatArray) -> tuple[FloatArray, BoolArray]:
        alpha, beta = self._shape()
        d = np.sqrt(beta * r2 + z * z)
        return 1.0 / (alpha * d + (1.0 - alpha) * z), (z > -self._edge() * d) & (d < np.inf)

    def _scale_derivatives(self, r2: FloatArray, z: FloatArray, shape: bool) -> ScaleDerivatives:
        alpha, beta = self._shape()
        d = np.sqrt(beta * r2 + z * z)
        scale, valid = self._scale(r2, z)
        minus = -scale * scale
        half = minus * alpha / d
        by_shape = (minus * (d - z), 0.5 * half * r2)[: self.parameters.size - 4] if shape else ()
        return ScaleDerivatives(scale, valid, half * beta, half * z + minus * (1.0 - alpha), by_shape)

    def _profile(self, radius2: FloatArray) -> tuple[FloatArray, FloatArray, BoolArray]:
        alpha, beta = self._shape()
        under = 1.0 - (2.0 * alpha - 1.0) * beta * radius2
        valid = (under >= 0.0) & np.isfinite(radius2)
        depth = (1.0 - alpha * alpha * beta * radius2) / (alpha * np.sqrt(under) + 1.0 - alpha)
        inverse = 1.0 / np.sqrt(radius2 + depth * depth)
        return inverse, depth * inverse, valid
