"""The Kannala-Brandt fisheye: radius as an odd polynomial of the angle, as in OpenCV's fisheye module.

Reference: J. Kannala, S. S. Brandt, "A generic camera model and calibration method for conventional, wide-angle, and
fish-eye lenses", PAMI 2006, equation (6). Unlike OpenCV's implementation it is right beyond 90 degrees off the axis.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import ClassVar, Self

import numpy as np

from rigkit.cameras.base import RadialCurve
from rigkit.cameras.monotone import KNOTS, first_root, horner, invert_increasing
from rigkit.cameras.radial import CompiledCamera
from rigkit.core.arrays import BoolArray, FloatArray


@dataclass(frozen=True, eq=False, slots=True, repr=False)
class KannalaBrandt(CompiledCamera):
    """|m| = theta (1 + k1 theta^2 + k2 theta^4 + k3 theta^6 + k4 theta^8), u = fx m_x + cx, v = fy m_y + cy.

    Parameters are fx, fy, cx, cy in px, k1..k4. The field of view ends where the curve stops rising, at most at
    180 degrees off the axis.
    """

    model: ClassVar[str] = "kannala_brandt"

    _max_angle: float = field(init=False, repr=False)

    @classmethod
    def from_radial_curve(cls, size_px: tuple[int, int], curve: RadialCurve, *, order: int | None = None) -> Self:
        theta, radius = curve.theta_rad, curve.radius_px
        # A curve with noise may be fitted best by a polynomial that turns down just outside it: then fewer terms.
        for terms in (5, 4, 3, 2, 1):
            powers = theta[:, None] ** np.arange(1, 2 * terms, 2)
            size = np.linalg.norm(powers, axis=0)
            a = np.linalg.lstsq(powers / size, radius, rcond=None)[0] / size
            shape = np.zeros(4)
            shape[: terms - 1] = a[1:] / a[0]
            camera = cls(size_px, np.array([a[0], a[0], *curve.centre_px, *shape]))
            if a[0] > 0.0 and camera.max_angle_rad > theta[-1]:
                return camera
        return camera

    @property
    def series(self) -> tuple[int, ...]:
        return (4, 5, 6, 7)

    @property
    def max_angle_rad(self) -> float:
        return self._max_angle

    def parameter_names(self) -> tuple[str, ...]:
        return ("fx", "fy", "cx", "cy", "k1", "k2", "k3", "k4")

    def _prepare(self) -> None:
        # d|m| / d theta as a polynomial in theta^2.
        slope = np.array([1.0, *((3.0 + 2.0 * k) * a for k, a in enumerate(self.parameters[4:].tolist()))])
        object.__setattr__(self, "_max_angle", math.sqrt(first_root(slope, math.pi**2)))

    def _shape(self) -> tuple[FloatArray, tuple[float, float]]:
        return self.parameters[4:], (self._max_angle, 0.0)

    def _profile(self, radius2: FloatArray) -> tuple[FloatArray, FloatArray, BoolArray]:
        radius = np.sqrt(radius2)
        knots = np.linspace(0.0, self._max_angle, KNOTS)
        values = knots * horner(np.concatenate([[1.0], self.parameters[4:]]), knots * knots)
        valid = radius <= values[-1]
        radius = np.where(valid, radius, 0.0)
        odd = np.zeros(10)
        odd[1], odd[3::2] = 1.0, self.parameters[4:]
        parts = np.zeros_like(radius), np.ones_like(radius), radius
        theta = invert_increasing(odd, parts, radius, knots, values)
        sine = np.where(radius > 0.0, np.sin(theta) / radius, 1.0)
        return sine, np.cos(theta), valid
