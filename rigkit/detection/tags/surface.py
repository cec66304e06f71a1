"""Where the points of a board whose points are not evenly spaced lie in an image, and how its lines run there.

A smooth map from the board's plane to the image, told by a calibrated camera from the board's pose, corrected by what
the points around leave over, or by the points around alone.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from rigkit.cameras.base import Camera
from rigkit.core.arrays import BoolArray, FloatArray, IntArray
from rigkit.geometry.rigid3 import Rigid3

MOST_DEGREE = 8
"""Of the polynomial that a lens adds to a perspective: a board that fills a fisheye of 180 degrees takes 7."""

POLYNOMIAL_POWERS = np.array([(degree - k, k) for degree in range(MOST_DEGREE + 1) for k in range(degree + 1)])
TERMS_OF_DEGREE = tuple((degree + 1) * (degree + 2) // 2 for degree in range(MOST_DEGREE + 1))
"""Terms x^i y^j of polynomials, and how many there are up to a degree."""

MAX_LEVERAGE = 0.99
"""A point that a term is there for alone is foretold by nothing."""

POINTS_A_TERM = 2.5
"""Points that there must be for each coefficient."""

NEAREST_DEPTH = 0.1
"""A perspective in which a point of the board is nearer than this part of the mean distance is no camera's: the lens is
a wide fisheye."""

CHORD = 0.4
"""Derivatives of a camera's projection are chords of this many sides of a tag to either side."""


@dataclass(frozen=True, eq=False, slots=True)
class TagSurface:
    """The map at M places of the board.

    Attributes
    ----------
    pixels : (M, 2)
    sides : (M, 2, 2) first derivatives along x and along y, px per unit of the board.
    bends : (M, 2, 2) second derivatives likewise.
    gain : (M,) standard deviation of `pixels` for points of standard deviation 1.
    """

    pixels: FloatArray
    sides: FloatArray
    bends: FloatArray
    gain: FloatArray

    def curvature(self) -> FloatArray:
        """Return the curvature of the lines along x and along y, (M, 2) 1/px, positive towards +90 degrees."""
        (a, b), (c, d) = self.sides.transpose(2, 1, 0), self.bends.transpose(2, 1, 0)
        return np.asarray((a * d - b * c).T / np.maximum((self.sides**2).sum(axis=2), 1e-12) ** 1.5)

    def heights(self) -> FloatArray:
        """Return how far a unit of the board lies from the line along x, and from that along y, (M, 2) px."""
        area = np.abs(self.sides[:, 0, 0] * self.sides[:, 1, 1] - self.sides[:, 0, 1] * self.sides[:, 1, 0])
        return np.asarray(area[:, None] / np.maximum(np.linalg.norm(self.sides, axis=2), 1e-9))

    def of(self, which: BoolArray) -> TagSurface:
        """Return the places `which` (M,)."""
        return TagSurface(self.pixels[which], self.sides[which], self.bends[which], self.gain[which])


class SmoothMap:
    """A smooth map through points at `places` (N, 2) of which the `pixels` (N, 2) are known.

    It is the map `base` of the board's plane, by default the perspective that fits best, and a polynomial for what that
    leaves: the lens, and the print. The polynomial has the degree that foretells points best that it was not fitted to.
    """

    def __init__(
        self, places: FloatArray, pixels: FloatArray, base: Callable[[FloatArray], TagSurface] | None = None
    ) -> None:
        self._places, self._pixels = places, pixels
        self._base = base or _perspective(places, pixels)
        rest, fewest = pixels, min(3, len(places))
        if self._base is not None:
            rest, fewest = pixels - self._base(places).pixels, 1
        seen = np.isfinite(rest[:, 0])
        self._polynomial = _Polynomial.through(places, np.where(seen[:, None], rest, 0.0), fewest)

    def at(self, wanted: FloatArray) -> TagSurface:
        """Return the map at `wanted` (M, 2), NaN where the base has none."""
        left = self._polynomial.at(wanted)
        if self._base is None:
            return left
        flat = self._base(wanted)
        return TagSurface(flat.pixels + left.pixels, flat.sides + left.sides, flat.bends + left.bends, left.gain)

    def beyond(self, wanted: FloatArray) -> TagSurface:
        """Return the map at `wanted` (M, 2), which may lie outside the points."""
        here, (left, gain) = self.at(wanted), self._polynomial.surest(wanted)
        return replace(here, pixels=left if self._base is None else self._base(wanted).pixels + left, gain=gain)

    def left_out(self) -> TagSurface:
        """Return the map at the places themselves, the pixels foretold by the other points."""
        leverage = self._polynomial.leverage
        gain = np.sqrt(leverage / (1.0 - leverage))
        return replace(self.at(self._places), pixels=self._pixels - self._polynomial.foretold, gain=gain)


def _perspective(places: FloatArray, pixels: FloatArray) -> Callable[[FloatArray], TagSurface] | None:
    """Return the perspective that fits the points best; None where none with all of them in front does."""
    normalise = []
    for points in (places, pixels):
        middle, size = points.mean(axis=0), max(float(points.std()), 1e-9)
        normalise.append(
            np.array([[1.0 / size, 0.0, -middle[0] / size], [0.0, 1.0 / size, -middle[1] / size], [0, 0, 1]])
        )
    (x, y), (u, v) = (
        (points * matrix[0, 0] + matrix[:2, 2]).T for points, matrix in zip((places, pixels), normalise, strict=True)
    )
    one, zero = np.ones_like(x), np.zeros_like(x)
    rows = np.concatenate(
        [
            np.stack([x, y, one, zero, zero, zero, -u * x, -u * y, -u], axis=1),
            np.stack([zero, zero, zero, x, y, one, -v * x, -v * y, -v], axis=1),
        ]
    )
    own = np.linalg.eigh(rows.T @ rows)[1][:, 0].reshape(3, 3)
    matrix = np.linalg.inv(normalise[1]) @ own @ normalise[0]
    matrix = matrix / (matrix[2] @ [*places.mean(axis=0), 1.0])
    depth = places @ matrix[2, :2] + matrix[2, 2]
    return partial(_projected, matrix) if depth.min() > NEAREST_DEPTH else None


def _projected(homography: FloatArray, places: FloatArray) -> TagSurface:
    """Return the map of a homography at places (M, 2)."""
    image = np.concatenate([places, np.ones((len(places), 1))], axis=1) @ homography.T
    depth = image[:, 2:]
    pixels = image[:, :2] / depth
    slope, turn = homography[:2, :2].T, homography[2, :2]
    sides = (slope - turn[:, None] * pixels[:, None]) / depth[:, None]
    bends = -2.0 * turn[:, None] * sides / depth[:, None]
    return TagSurface(pixels, sides, bends, np.zeros(len(places)))


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class _Polynomial:
    """Polynomials of every degree through N points, in T terms x^i y^j of places in units of `size` from `middle`.

    Attributes
    ----------
    triangle : (T, T) and told : (T, 2), the QR decomposition of the terms at the points, and the values in its basis.
    misses : (D,) how far off points usually lie where the others have them, by degree.
    best : degree with the smallest.
    foretold : (N, 2) how far the points lie off where the others have them, by that degree.
    leverage : (N,) of each point on its own value.
    """

    middle: FloatArray
    size: float
    triangle: FloatArray
    told: FloatArray
    misses: FloatArray
    best: int
    foretold: FloatArray
    leverage: FloatArray

    @classmethod
    def through(cls, places: FloatArray, values: FloatArray, fewest: int) -> _Polynomial:
        """Return those through `values` (N, 2); of `fewest` terms where the points are too few for more."""
        low, high = places.min(axis=0), places.max(axis=0)
        middle, size = 0.5 * (low + high), max(0.5 * float((high - low).max()), 1e-9)
        terms = max(int(len(places) / POINTS_A_TERM), fewest)
        ends = [end for end in TERMS_OF_DEGREE if end <= terms]
        basis, triangle = np.linalg.qr(_terms((places - middle) / size, POLYNOMIAL_POWERS[: ends[-1]]))
        told, leverages = basis.T @ values, np.minimum(np.cumsum(basis**2, axis=1), MAX_LEVERAGE)
        left = [(values - basis[:, :k] @ told[:k]) / (1.0 - leverages[:, k - 1, None]) for k in ends]
        misses = np.array([np.median(np.hypot(*foretold.T)) for foretold in left])
        best = int(misses.argmin())
        return cls(
            middle=middle,
            size=size,
            triangle=triangle,
            told=told,
            misses=misses,
            best=best,
            foretold=left[best],
            leverage=leverages[:, ends[best] - 1],
        )

    def at(self, wanted: FloatArray) -> TagSurface:
        """Return the map at `wanted` (M, 2) by the best degree."""
        here, end = (wanted - self.middle) / self.size, TERMS_OF_DEGREE[self.best]
        powers, triangle = POLYNOMIAL_POWERS[:end], self.triangle[:end, :end]
        factors, rows = np.linalg.solve(triangle, self.told[:end]), _terms(here, powers)
        x, y = (_terms(here, powers, along) @ factors / self.size for along in ((1, 0), (0, 1)))
        xx, yy = (_terms(here, powers, along) @ factors / self.size**2 for along in ((2, 0), (0, 2)))
        gain = np.linalg.norm(np.linalg.solve(triangle.T, rows.T), axis=0)
        return TagSurface(rows @ factors, np.stack([x, y], axis=1), np.stack([xx, yy], axis=1), gain)

    def surest(self, wanted: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the values at `wanted` (M, 2), each by the degree that is surest there, and their gain (M,).

        Beyond the points high degrees run wild: what counts is the usual miss times the gain.
        """
        rows = _terms((wanted - self.middle) / self.size, POLYNOMIAL_POWERS[: len(self.told)])
        parts, ends = np.linalg.solve(self.triangle.T, rows.T), np.array(TERMS_OF_DEGREE[: len(self.misses)]) - 1
        gains = np.sqrt(np.cumsum(parts**2, axis=0)[ends])
        values = np.cumsum(parts[:, :, None] * self.told[:, None], axis=0)[ends]
        surest, each = (self.misses[:, None] * np.maximum(gains, 1.0)).argmin(axis=0), np.arange(len(wanted))
        return values[surest, each], gains[surest, each]


def _terms(places: FloatArray, powers: IntArray, along: tuple[int, int] = (0, 0)) -> FloatArray:
    """Return the terms x^i y^j (N, T) of `powers` (T, 2), differentiated `along` x and y so often."""
    out = np.ones((len(places), len(powers)))
    most = int(powers.max(initial=0))
    for axis, times in enumerate(along):
        power = powers[:, axis]
        # Column k is the k-th power: pow() for every entry takes ten times as long.
        table = np.ones((len(places), most + 1))
        np.cumprod(np.broadcast_to(places[:, axis, None], (len(places), most)), axis=1, out=table[:, 1:])
        factor = np.ones(len(power))
        for k in range(times):
            factor *= power - k
        out *= table[:, np.maximum(power - times, 0)] * factor
    return out


def seen_surface(camera: Camera, cam_from_board: Rigid3, unit_mm: FloatArray, wanted: FloatArray) -> TagSurface:
    """Return the map at `wanted` (M, 2), in units of `unit_mm` (2,), as a camera sees it; NaN where it does not."""
    h = CHORD
    offsets = np.array([[0.0, 0.0], [h, 0.0], [-h, 0.0], [0.0, h], [0.0, -h]])
    places = (wanted + offsets[:, None]) * unit_mm
    points = np.concatenate([places, np.zeros((*places.shape[:2], 1))], axis=2)
    pixels, valid = camera.project(cam_from_board.apply(points))
    here, right, left, below, above = np.where(valid[..., None].all(axis=0), pixels, np.nan)
    return TagSurface(
        here,
        np.stack([right - left, below - above], axis=1) / (2.0 * h),
        np.stack([right - 2.0 * here + left, below - 2.0 * here + above], axis=1) / h**2,
        np.ones(len(wanted)),
    )
