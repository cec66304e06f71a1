"""The omnidirectional polynomial camera of Scaramuzza.

Reference: D. Scaramuzza, A. Martinelli, R. Siegwart, "A toolbox for easily calibrating omnidirectional cameras",
IROS 2006. Only the forward polynomial f(rho) is a parameter; projection solves for rho instead of fitting a second,
inverse polynomial, so that the two directions agree to rounding.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import ClassVar, Self

import numpy as np

from rigkit.cameras.base import RadialCurve, image_center
from rigkit.cameras.monotone import first_root, horner
from rigkit.cameras.radial import CompiledCamera
from rigkit.core.arrays import BoolArray, FloatArray
from rigkit.core.errors import InputError

DEGREES = range(3, 11)
DEFAULT_DEGREE = 6
"""Follows a lens of 185 degrees; degree 4 is enough to about 120, 200 degrees need 8."""
BEYOND_CORNERS = 1.5
"""The polynomial is taken to hold out to this multiple of the distance to the farthest corner of the image."""


@dataclass(frozen=True, eq=False, slots=True, repr=False)
class Scaramuzza(CompiledCamera):
    """The ray of (u', v') is along (u', v', f(rho)), rho = |(u', v')|, f(rho) = a0 + a2 rho^2 + ... + aN rho^N.

    (u, v) = [[c, d], [0, 1]] (u', v') + (cx, cy). Parameters are a0, a2, ..., aN, cx, cy, c, d; the degree N, 3 to 10,
    follows from their number. a0 > 0 looks forward (z > 0), f turns negative where the ray is beyond 90 degrees.

    Notes
    -----
    The published affine part is [[c, d], [e, 1]]. With all three free it contains the rotation about the optical axis
    (d = -e), which the pose has already: the normal equations are singular. Hence e = 0.
    """

    model: ClassVar[str] = "scaramuzza"
    orders: ClassVar[tuple[int, ...]] = tuple(DEGREES)

    _max_rho: float = field(init=False, repr=False)
    _polynomial: FloatArray = field(init=False, repr=False)

    @classmethod
    def from_radial_curve(cls, size_px: tuple[int, int], curve: RadialCurve, *, order: int | None = None) -> Self:
        degree = DEFAULT_DEGREE if order is None else order
        if degree not in DEGREES:
            raise InputError(f"scaramuzza camera: degree {degree}; choose {DEGREES[0]} to {DEGREES[-1]}")
        theta, rho = curve.theta_rad, curve.radius_px
        sine, cosine = np.sin(theta), np.cos(theta)
        unit_px = rho[-1]
        # A curve with noise may be fitted best by a polynomial that folds just outside it: then a lower degree.
        for used in range(degree, 2, -1):
            exponents = np.array([0, *range(2, used + 1)])
            columns = (rho[:, None] / unit_px) ** exponents
            weight = np.ones_like(rho)
            # r f = z rho is linear in f; divided by d/d rho of it, the residual is in px.
            for _ in range(2):
                a = np.linalg.lstsq((weight * sine)[:, None] * columns, weight * cosine * rho / unit_px, rcond=None)[0]
                slope = ((rho[:, None] / unit_px) ** np.maximum(exponents - 1, 0) * exponents) @ a
                weight = 1.0 / np.maximum(np.abs(sine * slope - cosine), 1e-3)
            shape = np.zeros(degree)
            shape[:used] = a * unit_px ** (1.0 - exponents)
            if shape[0] > 0.0:
                camera = cls(size_px, np.array([*shape, *curve.centre_px, 1.0, 0.0]))
                if camera.max_angle_rad > theta[-1]:
                    return camera
        raise InputError("radial curve: no scaramuzza polynomial with a0 > 0 follows it; check that radii are in px")

    @property
    def degree(self) -> int:
        return int(self.parameters.size) - 4

    @property
    def series(self) -> tuple[int, ...]:
        return tuple(range(1, self.degree))

    @property
    def max_angle_rad(self) -> float:
        return float(np.arctan2(self._max_rho, horner(self._polynomial, np.array([self._max_rho]))[0]))

    def parameter_names(self) -> tuple[str, ...]:
        degree = min(max(self.degree, DEGREES[0]), DEGREES[-1])
        return ("a0", *(f"a{k}" for k in range(2, degree + 1)), "cx", "cy", "c", "d")

    def _prepare(self) -> None:
        n = self.degree
        a0, c = self.parameters[0], self.parameters[-2]
        if a0 <= 0.0 or c == 0.0:
            raise InputError(f"scaramuzza camera: a0 = {a0:g} and c = {c:g}; a0 must be positive, c not zero")
        polynomial = np.insert(self.parameters[:n], 1, 0.0)
        k = np.arange(n + 1)
        offset = np.abs(self.parameters[n : n + 2] - image_center(self.size_px)) + 0.5 * np.array(self.size_px)
        # d angle / d rho has the sign of f - rho f'; where that ends, the image folds back.
        limit = BEYOND_CORNERS * float(np.linalg.norm(offset))
        object.__setattr__(self, "_polynomial", polynomial)
        object.__setattr__(self, "_max_rho", first_root(polynomial * (1.0 - k), limit))

    def _linear(self) -> tuple[float, float, float, float, float]:
        cx, cy, c, d = self.parameters[-4:].tolist()
        return c, d, 1.0, cx, cy

    def _shape(self) -> tuple[FloatArray, tuple[float, float]]:
        return self._polynomial, (0.0, self._max_rho)

    def _profile(self, radius2: FloatArray) -> tuple[FloatArray, FloatArray, BoolArray]:
        rho = np.sqrt(radius2)
        f = horner(self._polynomial, rho)
        inverse = 1.0 / np.sqrt(radius2 + f * f)
        return inverse, f * inverse, rho <= self._max_rho
