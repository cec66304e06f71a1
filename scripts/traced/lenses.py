"""Formulas of the lenses that Cycles renders, independent of rigkit's, to be used as truth.

Pixel (0, 0) is the centre of the top-left pixel, the camera looks along +z with x to the right and y down. Centroids of
small discs rendered by Cycles agree with these formulas to 0.002 px (perspective) and 0.008 px (fisheye) RMS, which is
the noise of 256 samples per pixel, and to 0.001 px on average.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from rigkit.core.arrays import BoolArray, FloatArray

TERMS = 4
"""Of Cycles' polynomial lens, beside the constant one."""
NEWTON_STEPS = 4
TABLE = 4001
SLOPE_STEP_PX = 1e-4


@dataclass(frozen=True, slots=True)
class Lens:
    """How an angle from the axis becomes a distance from the principal point.

    Attributes
    ----------
    kind : "perspective", r = f tan(t); "equisolid", r = 2 f sin(t / 2); or "polynomial", t = sum of terms[k] r^(k + 1).
    size_px : (width, height).
    focal_px : f; of polynomials 1 / terms[0].
    offset_px : whole pixels from the middle of the picture to the principal point.
    field_deg : full angle of view; beyond it the picture is black.
    terms : of the polynomial, rad / px^(k + 1).
    """

    kind: str
    size_px: tuple[int, int]
    focal_px: float
    offset_px: tuple[int, int] = (0, 0)
    field_deg: float = 180.0
    terms: tuple[float, ...] = ()

    @classmethod
    def from_truth(cls, values: dict[str, Any]) -> Lens:
        """Return the lens that `truth` wrote."""
        pairs = {name: tuple(values[name]) for name in ("size_px", "offset_px", "terms")}
        return cls(**{**values, **pairs})

    def truth(self) -> dict[str, Any]:
        return asdict(self)

    @property
    def centre_px(self) -> FloatArray:
        return (np.array(self.size_px) - 1.0) / 2.0 + self.offset_px

    def angle(self, radius_px: FloatArray) -> FloatArray:
        """Return the angle from the axis, rad, of pixels so far from the principal point."""
        if self.kind == "perspective":
            return np.arctan(radius_px / self.focal_px)
        if self.kind == "equisolid":
            return 2.0 * np.arcsin(np.minimum(radius_px / (2.0 * self.focal_px), 1.0))
        return np.asarray(sum(term * radius_px ** (k + 1) for k, term in enumerate(self.terms)))

    def unproject(self, pixels: FloatArray) -> FloatArray:
        """Return the unit rays (..., 3) of pixels (..., 2)."""
        d = pixels - self.centre_px
        r = np.linalg.norm(d, axis=-1)
        theta = self.angle(r)
        across = d * (np.sin(theta) / np.where(r > 0.0, r, 1.0))[..., None]
        return np.concatenate([across, np.cos(theta)[..., None]], axis=-1)

    def project(self, points: FloatArray) -> tuple[FloatArray, BoolArray]:
        """Return the pixels (..., 2) of points (..., 3) and which lie in the field of view."""
        across = np.linalg.norm(points[..., :2], axis=-1)
        theta = np.arctan2(across, points[..., 2])
        pixels = (
            self.centre_px + points[..., :2] * (self._radius(theta) / np.where(across > 0.0, across, 1.0))[..., None]
        )
        return pixels, theta < np.radians(self.field_deg) / 2.0

    def _radius(self, theta: FloatArray) -> FloatArray:
        # A table up to where the angle stops to grow, then Newton's method.
        table = np.linspace(0.0, 1.5 * float(np.hypot(*self.size_px)), TABLE)
        angles = self.angle(table)
        falls = np.flatnonzero(np.diff(angles) <= 0.0)
        end = int(falls[0]) + 1 if len(falls) else TABLE
        r = np.interp(theta, angles[:end], table[:end])
        for _ in range(NEWTON_STEPS):
            slope = (self.angle(r + SLOPE_STEP_PX) - self.angle(r - SLOPE_STEP_PX)) / (2.0 * SLOPE_STEP_PX)
            r = np.clip(r - (self.angle(r) - theta) / np.where(slope > 0.0, slope, np.inf), 0.0, table[-1])
        return r


def polynomial_lens(
    size_px: tuple[int, int],
    radius_px: Callable[[FloatArray], FloatArray],
    half_deg: float,
    offset_px: tuple[int, int] = (0, 0),
) -> Lens:
    """Return the polynomial lens nearest to r = radius_px(theta) up to `half_deg`: the polynomial is the truth."""
    theta = np.radians(np.linspace(0.0, half_deg, 400)[1:])
    r = radius_px(theta)
    powers = np.arange(1, TERMS + 1)
    scaled = np.linalg.lstsq((r[:, None] / r[-1]) ** powers, theta, rcond=None)[0]
    terms = tuple(float(term) for term in scaled / r[-1] ** powers)
    return Lens("polynomial", size_px, 1.0 / terms[0], offset_px, 2.0 * half_deg, terms)
