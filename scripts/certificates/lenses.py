"""Lenses that no model fits: rotationally symmetric with arbitrary curves, decentred."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import ClassVar, Self

import numpy as np
from numpy.typing import ArrayLike

from rigkit.calibration.certainty.displaced import DisplacedCamera
from rigkit.cameras.base import Camera, RadialCurve
from rigkit.cameras.radial import FocalCamera, ScaleDerivatives
from rigkit.core.arrays import BoolArray, FloatArray
from rigkit.kernels.departures import DISPLACEMENTS

Curve = Callable[[FloatArray], FloatArray]

CURVES: dict[str, tuple[float, float, Curve]] = {
    "rational": (1000.0, 50.0, lambda a: np.tan(a) * (1.0 - 0.1 * np.tan(a) ** 2) / (1.0 + 0.1 * np.tan(a) ** 2)),
    "sine": (1000.0, 60.0, lambda a: np.sin(1.2 * a) / 1.2),
    "moustache": (1000.0, 50.0, lambda a: np.tan(a) * (1.0 - 0.12 * np.tan(a) ** 2 + 0.1 * np.tan(a) ** 4)),
    "arsinh": (1000.0, 60.0, lambda a: np.arcsinh(0.7 * np.tan(a)) / 0.7),
    "near stereographic": (480.0, 100.0, lambda a: 2.4 * np.tan(a / 2.4)),
    "near equisolid": (560.0, 100.0, lambda a: 1.8 * np.sin(a / 1.8) + 0.004 * (1.0 - np.cos(4.0 * a))),
}
"""Focal length about, px, how far off the axis the curve goes, degrees, and image radius over focal length by angle."""
DECENTRED = slice(5, 7)
"""Which of the displacements are decentring of the first order."""
SAMPLES = 20001
STEP_RAD = 1e-6


@dataclass(frozen=True, eq=False, slots=True, repr=False)
class RoundLens(FocalCamera):
    """A lens with one of the CURVES; parameters are fx, fy, cx, cy in px."""

    kind: str

    model: ClassVar[str] = "round"

    @classmethod
    def from_radial_curve(cls, size_px: tuple[int, int], curve: RadialCurve, *, order: int | None = None) -> Self:
        raise NotImplementedError("a lens that is looked through, not fitted")

    def with_parameters(self, parameters: ArrayLike) -> Self:
        return type(self)(self.size_px, np.asarray(parameters, dtype=np.float64), self.kind)

    def parameter_names(self) -> tuple[str, ...]:
        return "fx", "fy", "cx", "cy"

    @property
    def max_angle_rad(self) -> float:
        return float(np.radians(CURVES[self.kind][1]))

    def _scale(self, r2: FloatArray, z: FloatArray) -> tuple[FloatArray, BoolArray]:
        r = np.maximum(np.sqrt(r2), 1e-12)
        angle = np.arctan2(r, z)
        return CURVES[self.kind][2](angle) / r, angle < self.max_angle_rad

    def _scale_derivatives(self, r2: FloatArray, z: FloatArray, shape: bool) -> ScaleDerivatives:
        scale, valid = self._scale(r2, z)
        r = np.maximum(np.sqrt(r2), 1e-9)
        angle, curve = np.arctan2(r, z), CURVES[self.kind][2]
        slope = (curve(angle + STEP_RAD) - curve(angle - STEP_RAD)) / (2.0 * STEP_RAD) / (r2 + z * z)
        return ScaleDerivatives(scale, valid, (slope * z / r - scale / r) / r, -slope, ())

    def _profile(self, radius2: FloatArray) -> tuple[FloatArray, FloatArray, BoolArray]:
        radius, curve = np.sqrt(radius2), CURVES[self.kind][2]
        table = np.linspace(0.0, self.max_angle_rad, SAMPLES)
        angle = np.interp(radius, curve(table), table)
        for _ in range(3):
            slope = (curve(angle + STEP_RAD) - curve(angle - STEP_RAD)) / (2.0 * STEP_RAD)
            angle = angle - (curve(angle) - radius) / slope
        sine = np.where(radius > 1e-9, np.sin(angle) / np.maximum(radius, 1e-9), 1.0)
        return sine, np.cos(angle), angle < self.max_angle_rad


def strange_lens(kind: str, size_px: tuple[int, int], decentred_px: float, rng: np.random.Generator) -> Camera:
    """Return a lens of a kind, its centre off the middle, decentred by so many pixels at the image's corners."""
    focal = CURVES[kind][0] * rng.uniform(0.95, 1.05)
    centre = np.array(size_px) / 2.0 + rng.normal(0.0, 8.0, 2)
    lens = RoundLens(size_px, np.array([focal, focal * (1.0 + rng.normal(0.0, 1e-3)), *centre]), kind)
    amounts = np.zeros(DISPLACEMENTS)
    amounts[DECENTRED] = decentred_px * rng.normal(size=2)
    return DisplacedCamera(size_px, np.append(lens.parameters, amounts), lens, np.eye(DISPLACEMENTS))
