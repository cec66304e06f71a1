"""The perspective camera with Brown's radial and tangential distortion, parameters in OpenCV's order.

Reference: D. C. Brown, "Close-range camera calibration", 1971; the rational form of 8 terms as in OpenCV.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import ClassVar, Self

import numpy as np

from rigkit.cameras.base import Camera, RadialCurve
from rigkit.cameras.monotone import KNOTS, first_root, horner
from rigkit.core.arrays import BoolArray, Coordinates, FloatArray, Projected
from rigkit.core.errors import InputError
from rigkit.kernels.cameras import brown_pixels, brown_places

FARTHEST = 50.0
"""Tangent of 88.9 degrees: no lens of this kind sees further."""


@dataclass(frozen=True, eq=False, slots=True, repr=False)
class Brown(Camera):
    """With (x, y) = (X/Z, Y/Z) and t = x^2 + y^2:  m = L(t) (x, y) + tangential,  u = fx m_x + cx, v = fy m_y + cy.

    L = (1 + k1 t + k2 t^2 + k3 t^3) / (1 + k4 t + k5 t^2 + k6 t^3); tangential =
    (2 p1 x y + p2 (t + 2 x^2), p1 (t + 2 y^2) + 2 p2 x y). Parameters are fx, fy, cx, cy, k1, k2, p1, p2 (four terms:
    Kalibr's radtan, plumb_bob without k3), then k3 (five), then k4, k5, k6 (eight: the rational form).

    Notes
    -----
    The field of view ends at the circle in (x, y) inside which the map is proved to be one to one. The tangential part
    has a symmetric derivative with eigenvalues of at most 6 |p| sqrt(t), the radial part one with the eigenvalues L
    and d(L r)/dr. While both exceed the former, the derivative of the sum is positive definite on a convex set and the
    image does not fold back. Unprojection refuses everything outside.
    """

    model: ClassVar[str] = "brown"
    orders: ClassVar[tuple[int, ...]] = (4, 5, 8)

    _max_r: float = field(init=False, repr=False)

    @classmethod
    def from_radial_curve(cls, size_px: tuple[int, int], curve: RadialCurve, *, order: int | None = None) -> Self:
        count = 5 if order is None else order
        if count not in cls.orders:
            raise InputError(f"brown camera: {count} distortion terms; choose 4 (without k3), 5 or 8")
        theta, radius = curve.below(np.pi / 2, cls.model)
        r = np.tan(theta)
        # A curve with noise may be fitted best by a polynomial that turns down just outside it: then fewer terms.
        for top, bottom in ((3, 3), (3, 0), (2, 0), (1, 0), (0, 0))[{8: 0, 5: 1, 4: 2}[count] :]:
            # radius (1 + k4 t + ...) = f r (1 + k1 t + ...) is linear in f, f k1, ..., k4, ...
            columns = np.concatenate(
                [
                    r[:, None] ** np.arange(1, 2 * top + 2, 2),
                    -radius[:, None] * r[:, None] ** np.arange(2, 2 * bottom + 1, 2),
                ],
                axis=1,
            )
            size = np.linalg.norm(columns, axis=0)
            a = np.linalg.lstsq(columns / size, radius, rcond=None)[0] / size
            k = np.zeros(6)
            k[:top], k[3 : 3 + bottom] = a[1 : top + 1] / a[0], a[top + 1 :]
            shape = np.array([k[0], k[1], 0.0, 0.0, *k[2:]])[:count]
            camera = cls(size_px, np.array([a[0], a[0], *curve.centre_px, *shape]))
            if a[0] > 0.0 and camera.max_angle_rad > theta[-1]:
                return camera
        return camera

    @property
    def series(self) -> tuple[int, ...]:
        # The rational form is no power series.
        return {8: (4, 5), 9: (4, 5, 8)}.get(self.parameters.size, ())

    @property
    def max_angle_rad(self) -> float:
        return float(np.arctan(self._max_r))

    def parameter_names(self) -> tuple[str, ...]:
        names = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3")
        if self.parameters.size == 8:
            return names[:8]
        return (*names, "k4", "k5", "k6") if self.parameters.size > 9 else names

    def _polynomials(self) -> tuple[list[float], list[float]]:
        """Numerator and denominator of L as polynomials in t."""
        values = self.parameters.tolist()
        return [1.0, *values[4:6], values[8] if len(values) > 8 else 0.0], [1.0, *values[9:]]

    def _prepare(self) -> None:
        top, bottom = self._polynomials()
        bound = 6.0 * math.hypot(*self.parameters[6:8].tolist())
        # d(L r)/dr = L + 2 t L' = [(N + 2 t N') D - 2 t N D'] / D^2, in powers of t; both are to exceed bound * r.
        slope = _product([(1.0 + 2.0 * k) * a for k, a in enumerate(top)], bottom)
        less = _product(top, [2.0 * k * a for k, a in enumerate(bottom)])
        by_r = np.zeros((2, 2 * max(len(slope), 2 * len(bottom)) - 1))
        by_r[0, : 2 * len(slope) : 2] = [a - b for a, b in zip(slope, less, strict=True)]
        by_r[1, : 2 * len(slope) : 2] = _product(top, bottom)
        by_r[:, 1 : 4 * len(bottom) - 2 : 2] = [-bound * a for a in _product(bottom, bottom)]
        limit = first_root(by_r, FARTHEST)
        if len(bottom) > 1:
            limit = min(limit, math.sqrt(first_root(np.array(bottom), FARTHEST**2)))
        object.__setattr__(self, "_max_r", limit)

    def _project(self, x: FloatArray, y: FloatArray, z: FloatArray) -> Projected:
        return brown_pixels((x, y, z), self.parameters, self._max_r)

    def _unproject(self, u: FloatArray, v: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray, BoolArray]:
        fx, fy, cx, cy = self.parameters[:4].tolist()
        m = np.stack([(u - cx) / fx, (v - cy) / fy])
        valid = np.isfinite(m[0] + m[1])
        m = np.where(valid, m, 0.0)
        plane, settled = brown_places(m, self._radial_start(m), self.parameters, self._max_r)
        valid &= settled
        z = 1.0 / np.sqrt(1.0 + plane[0] ** 2 + plane[1] ** 2)
        return plane[0] * z, plane[1] * z, z, valid

    def _radial_start(self, m: FloatArray) -> FloatArray:
        """Return the (x, y) that the radial part alone maps to m (2, N), or the edge of the field of view."""
        # Even steps of the angle, because r runs away towards 90 degrees.
        knots = np.tan(np.linspace(0.0, np.arctan(self._max_r), KNOTS))
        radius = np.sqrt(m[0] ** 2 + m[1] ** 2)
        # Where the denominator vanishes at the edge, rounding may have it infinite or negative there.
        top, bottom = (horner(np.array(polynomial), knots * knots) for polynomial in self._polynomials())
        values = np.fmax.accumulate(knots * (top / bottom))
        found = np.interp(radius, values, knots)
        return np.asarray(found / np.where(radius > 0.0, radius, 1.0) * m)

    def _derivatives(
        self, at: Coordinates, d_pixels_d_point: FloatArray, d_pixels_d_parameters: FloatArray | None
    ) -> Projected:
        return brown_pixels(at, self.parameters, self._max_r, d_pixels_d_point, d_pixels_d_parameters)


def _product(a: list[float], b: list[float]) -> list[float]:
    """Return the product of two polynomials: of so few terms numpy would take several times as long."""
    out = [0.0] * (len(a) + len(b) - 1)
    for i, x in enumerate(a):
        for j, y in enumerate(b):
            out[i + j] += x * y
    return out
