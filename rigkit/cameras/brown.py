"""The perspective camera with Brown's radial and tangential distortion, parameters in OpenCV's order.

Reference: D. C. Brown, "Close-range camera calibration", 1971; the rational form of 8 terms as in OpenCV.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import ClassVar, Self

import numpy as np
from numpy.typing import ArrayLike

from rigkit.arrays import BoolArray, FloatArray
from rigkit.cameras.base import Camera
from rigkit.cameras.monotone import first_root, horner
from rigkit.cameras.radial import checked_curve
from rigkit.errors import InputError

__all__ = ["Brown"]

FARTHEST = 50.0
"""Tangent of 88.9 degrees: no lens of this kind sees further."""
KNOTS = 129
"""Samples of the radial curve from which its inverse starts."""
STEPS = 30
SETTLED = 1e-13
"""Newton in the plane stops at this step, in units of the focal length."""


@dataclass(frozen=True, eq=False, slots=True)
class Brown(Camera):
    """With (x, y) = (X/Z, Y/Z) and t = x^2 + y^2:  m = L(t) (x, y) + tangential,  u = fx m_x + cx, v = fy m_y + cy.

    L = (1 + k1 t + k2 t^2 + k3 t^3) / (1 + k4 t + k5 t^2 + k6 t^3); tangential =
    (2 p1 x y + p2 (t + 2 x^2), p1 (t + 2 y^2) + 2 p2 x y). Parameters are fx, fy, cx, cy, k1, k2, p1, p2, k3 and, in
    the rational form, k4, k5, k6.

    Notes
    -----
    The field of view ends at the circle in (x, y) inside which the map is proved to be one to one. The tangential part
    has a symmetric derivative with eigenvalues of at most 6 |p| sqrt(t), the radial part one with the eigenvalues L
    and d(L r)/dr. While both exceed the former, the derivative of the sum is positive definite on a convex set and the
    image does not fold back. Unprojection refuses everything outside.
    """

    model: ClassVar[str] = "brown"

    _max_r: float = field(init=False, repr=False)

    @classmethod
    def from_radial_curve(
        cls,
        size_px: tuple[int, int],
        centre_px: ArrayLike,
        theta_rad: ArrayLike,
        radius_px: ArrayLike,
        *,
        order: int | None = None,
    ) -> Self:
        count = 5 if order is None else order
        if count not in (4, 5, 8):
            raise InputError(f"brown camera: {count} distortion terms; choose 4 (k3 stays 0), 5 or 8")
        centre, theta, radius = checked_curve(centre_px, theta_rad, radius_px, cls.model, below_rad=np.pi / 2)
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
            shape = np.array([k[0], k[1], 0.0, 0.0, *k[2:]])[: max(count, 5)]
            camera = cls(size_px, np.array([a[0], a[0], *centre, *shape]))
            if a[0] > 0.0 and camera.max_angle_rad > theta[-1]:
                return camera
        return camera

    @property
    def max_angle_rad(self) -> float:
        return float(np.arctan(self._max_r))

    def parameter_names(self) -> tuple[str, ...]:
        names = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3")
        return (*names, "k4", "k5", "k6") if self.parameters.size > 9 else names

    def _polynomials(self) -> tuple[FloatArray, FloatArray]:
        """Numerator and denominator of L as polynomials in t."""
        k1, k2, _, _, k3 = self.parameters[4:9]
        return np.array([1.0, k1, k2, k3]), np.concatenate([[1.0], self.parameters[9:]])

    def _prepare(self) -> None:
        top, bottom = self._polynomials()
        bound = 6.0 * np.hypot(self.parameters[6], self.parameters[7])
        # d(L r)/dr = L + 2 t L' = [(N + 2 t N') D - 2 t N D'] / D^2, in powers of t and then of r.
        k, j = np.arange(top.size), np.arange(bottom.size)
        radial = np.convolve(top * (1.0 + 2.0 * k), bottom) - 2.0 * np.convolve(top, bottom * j)
        bottom2 = np.convolve(bottom, bottom)
        limit = FARTHEST
        for value in (_at_squares(radial), _at_squares(np.convolve(top, bottom))):
            limit = first_root(_minus(value, bound, bottom2), limit)
        if bottom.size > 1:
            limit = first_root(_at_squares(bottom), limit)
        object.__setattr__(self, "_max_r", limit)

    def _distort(
        self, x: FloatArray, y: FloatArray, t: FloatArray, *, slope: bool
    ) -> tuple[FloatArray, FloatArray, FloatArray, tuple[FloatArray, FloatArray, FloatArray]]:
        """Return m_x, m_y, L and, where `slope`, the entries xx, xy, yy of the symmetric d m / d (x, y)."""
        top, bottom = self._polynomials()
        p1, p2 = self.parameters[6:8].tolist()
        factor, denominator = horner(top, t), horner(bottom, t)
        factor /= denominator
        mx = factor * x + p2 * (t + 2.0 * x * x) + 2.0 * p1 * x * y
        my = factor * y + p1 * (t + 2.0 * y * y) + 2.0 * p2 * x * y
        if not slope:
            return mx, my, factor, (t, t, t)
        by_t = horner(top[1:] * np.arange(1, 4), t)
        if bottom.size > 1:
            by_t -= factor * horner(bottom[1:] * np.arange(1, 4), t)
            by_t /= denominator
        by_t *= 2.0
        xx = factor + by_t * x * x + 2.0 * p1 * y + 6.0 * p2 * x
        xy = by_t * x * y + 2.0 * p1 * x + 2.0 * p2 * y
        yy = factor + by_t * y * y + 6.0 * p1 * y + 2.0 * p2 * x
        return mx, my, factor, (xx, xy, yy)

    def _plane(
        self, x: FloatArray, y: FloatArray, z: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray, BoolArray]:
        """Return 1/z, x/z, y/z, t, valid."""
        inverse = 1.0 / z
        x, y = x * inverse, y * inverse
        t = x * x + y * y
        return inverse, x, y, t, (z > 0.0) & (t <= self._max_r**2)

    def _project(self, x: FloatArray, y: FloatArray, z: FloatArray) -> tuple[FloatArray, FloatArray, BoolArray]:
        _, x, y, t, valid = self._plane(x, y, z)
        mx, my, _, _ = self._distort(x, y, t, slope=False)
        fx, fy, cx, cy = self.parameters[:4]
        return fx * mx + cx, fy * my + cy, valid

    def _unproject(self, u: FloatArray, v: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray, BoolArray]:
        fx, fy, cx, cy = self.parameters[:4]
        mx, my = (u - cx) / fx, (v - cy) / fy
        valid = np.isfinite(mx + my)
        x, y = self._radial_start(np.where(valid, mx, 0.0), np.where(valid, my, 0.0))
        moving = np.flatnonzero(valid)
        for _ in range(STEPS):
            px, py = x[moving], y[moving]
            gx, gy, _, (xx, xy, yy) = self._distort(px, py, px * px + py * py, slope=True)
            gx, gy = gx - mx[moving], gy - my[moving]
            determinant = xx * yy - xy * xy
            dx, dy = (yy * gx - xy * gy) / determinant, (xx * gy - xy * gx) / determinant
            # Kept inside the circle, where the derivative is positive definite: Newton cannot leave for another branch.
            px, py = px - dx, py - dy
            pull = np.minimum(1.0, self._max_r / np.sqrt(px * px + py * py + 1e-300))
            x[moving], y[moving] = pull * px, pull * py
            moving = moving[~(np.abs(dx) + np.abs(dy) <= SETTLED * (1.0 + np.abs(px) + np.abs(py)))]
            if not moving.size:
                break
        valid[moving] = False
        z = 1.0 / np.sqrt(1.0 + x * x + y * y)
        return x * z, y * z, z, valid

    def _radial_start(self, mx: FloatArray, my: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return (x, y) that the radial part alone maps to m, or the edge of the field of view."""
        top, bottom = self._polynomials()
        # Even steps of the angle, because r runs away towards 90 degrees.
        knots = np.tan(np.linspace(0.0, np.arctan(self._max_r), KNOTS))
        values = knots * horner(top, knots * knots) / horner(bottom, knots * knots)
        radius = np.sqrt(mx * mx + my * my)
        share = np.interp(radius, values, knots) / np.where(radius > 0.0, radius, 1.0)
        return share * mx, share * my

    def _derivatives(
        self, x: FloatArray, y: FloatArray, z: FloatArray, by_point: FloatArray, by_parameter: FloatArray | None
    ) -> tuple[FloatArray, FloatArray, BoolArray]:
        inverse, x, y, t, valid = self._plane(x, y, z)
        mx, my, factor, (xx, xy, yy) = self._distort(x, y, t, slope=True)
        fx, fy, cx, cy = self.parameters[:4].tolist()
        for row, (focal, a, b) in enumerate(((fx, xx, xy), (fy, xy, yy))):
            a, b = focal * inverse * a, focal * inverse * b
            by_point[row, 0], by_point[row, 1] = a, b
            by_point[row, 2] = -(a * x + b * y)
        if by_parameter is not None:
            self._fill_parameters(by_parameter, x, y, t, factor, (mx, my))
        return fx * mx + cx, fy * my + cy, valid

    def _fill_parameters(
        self,
        out: FloatArray,
        x: FloatArray,
        y: FloatArray,
        t: FloatArray,
        factor: FloatArray,
        m: tuple[FloatArray, ...],
    ) -> None:
        fx, fy = self.parameters[:2].tolist()
        out[0, 0], out[1, 1] = m
        out[0, 2] = out[1, 3] = 1.0
        over = 1.0 / horner(self._polynomials()[1], t)
        self._fill_powers(out, (4, 5, 8), (fx * x * over, fy * y * over), t)
        if out.shape[1] > 9:
            over = -factor * over
            self._fill_powers(out, (9, 10, 11), (fx * x * over, fy * y * over), t)
        cross = 2.0 * x * y
        out[0, 6], out[0, 7] = fx * cross, fx * (t + 2.0 * x * x)
        out[1, 6], out[1, 7] = fy * (t + 2.0 * y * y), fy * cross

    @staticmethod
    def _fill_powers(
        out: FloatArray, columns: tuple[int, ...], g: tuple[FloatArray, FloatArray], t: FloatArray
    ) -> None:
        """Write g t, g t^2, g t^3 into the columns given."""
        power = t
        for column in columns:
            np.multiply(g[0], power, out=out[0, column])
            np.multiply(g[1], power, out=out[1, column])
            power = power * t


def _at_squares(coefficients: FloatArray) -> FloatArray:
    """Coefficients in r of a polynomial in t = r^2."""
    out = np.zeros(2 * coefficients.size - 1)
    out[::2] = coefficients
    return out


def _minus(value: FloatArray, bound: float, weight: FloatArray) -> FloatArray:
    """Coefficients in r of value(r) - bound * r * weight(r^2)."""
    shifted = np.concatenate([[0.0], bound * _at_squares(weight)])
    out = np.zeros(max(value.size, shifted.size))
    out[: value.size] += value
    out[: shifted.size] -= shifted
    return out
