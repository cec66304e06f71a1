"""The kernels in surface.c: the map from a board's plane to an image, and the brightness of the modules of tags."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rigkit.core.arrays import FloatArray, GreyImage
from rigkit.kernels import kernels
from rigkit.kernels.calls import image_arguments
from rigkit.kernels.declarations import header

SURFACE_DEGREE = header().constants["SURFACE_DEGREE"]
"""Of the polynomial that a lens adds to a perspective: a board that fills a fisheye of 180 degrees takes degree 7."""

TERMS_OF_DEGREE = tuple((degree + 1) * (degree + 2) // 2 for degree in range(SURFACE_DEGREE + 1))
"""How many terms x^i y^j there are up to a degree."""

HARDLY_MORE = 1.25
"""Times the least miss: what is beyond such a degree is less than what points scatter, and over a board so many
windows wide it bends no line within one. But the 8th, where it misses by a tenth less than the 3rd, bends lines at the
rim by up to 8 px within a window (REAL)."""


def perspective(places: FloatArray, pixels: FloatArray) -> tuple[FloatArray, float]:
    """Return the homography (3, 3) that takes `places` (N, 2) nearest to `pixels` (N, 2), of depth 1 at their mean, and
    the least depth of a place (Hartley and Zisserman, Multiple View Geometry, 2004, algorithm 4.2).
    """
    out = np.empty((3, 3))
    known = (np.ascontiguousarray(part, np.float64) for part in (places, pixels))
    return out, float(kernels().fit_perspective(*known, len(places), out))


def projected(homography: FloatArray, places: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return where a homography (3, 3) takes `places` (M, 2), and the first and second derivatives along x and along y,
    (M, 2, 2)."""
    out = np.empty((5, len(places), 2))
    places, homography = np.ascontiguousarray(places, np.float64), np.ascontiguousarray(homography, np.float64)
    kernels().project_places(places, len(places), homography, out)
    return _parted(out)


def _parted(out: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return values (M, 2) and derivatives (M, 2, 2) of what kernels write, (5, M, 2)."""
    return out[0], out[1:3].transpose(1, 0, 2), out[3:].transpose(1, 0, 2)


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class Polynomials:
    """Polynomials of every degree through N points, in T terms x^i y^j of places in units of `size` from `middle`.

    Attributes
    ----------
    triangle : (T, T) and told : (T, 2), the QR decomposition of the terms at the points, and the values in its basis;
        the diagonal of a term that the others are as good as at these points is 0.
    misses : (D,) how far off points usually lie where the others have them, by degree; infinite where that was not
        tried, for there are too few points, or from degree 6 on no better ones among the two degrees before.
    best : degree with the smallest.
    plain : the lowest degree that misses by hardly more: what further terms add is noise, which bends lines at the rim.
    foretold : (N, 2) how far the points lie off where the others have them, by that degree.
    leverage : (N,) of each point on its own value.
    """

    middle: FloatArray
    size: float
    triangle: FloatArray
    told: FloatArray
    misses: FloatArray
    best: int
    plain: int
    foretold: FloatArray
    leverage: FloatArray

    @classmethod
    def through(
        cls, places: FloatArray, values: FloatArray, middle: FloatArray, size: float, most: int, most_leverage: float
    ) -> Polynomials:
        """Return those through `values` (N, 2) at `places` (N, 2), of `most` terms at most."""
        terms, count = max(end for end in TERMS_OF_DEGREE if end <= most), len(places)
        triangle, told, misses = np.zeros((terms, terms)), np.empty((terms, 2)), np.empty(SURFACE_DEGREE + 1)
        foretold, leverage = np.empty((count, 2)), np.empty(count)
        best = kernels().fit_polynomials(
            *(np.ascontiguousarray(part, np.float64) for part in (places, values)),
            *(count, float(middle[0]), float(middle[1]), size, terms, most_leverage, np.empty((terms, count))),
            *(triangle, told, np.empty((4, count)), misses, foretold, leverage),
        )
        return cls(
            middle=middle,
            size=size,
            triangle=triangle,
            told=told,
            misses=misses,
            best=int(best),
            plain=int(np.argmax(misses <= HARDLY_MORE * misses[best])),
            foretold=foretold,
            leverage=leverage,
        )

    def at(self, wanted: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return the values at `wanted` (M, 2) by the plain degree, and their first and second derivatives along x and
        along y, (M, 2, 2)."""
        out = np.empty((5, len(wanted), 2))
        kernels().polynomial_at(*self._asked(wanted), self.plain, self.triangle, self.told, out)
        return _parted(out)

    def surest(self, wanted: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the values at `wanted` (M, 2), each by the degree that is surest there, and their gain (M,): the
        standard deviation for points of standard deviation 1.

        Beyond the points high degrees run wild: what counts is the usual miss times the gain.
        """
        out = np.empty((len(wanted), 3))
        kernels().surest_polynomial(*self._asked(wanted), self.triangle, self.told, self.misses, out)
        return out[:, :2], out[:, 2]

    def _asked(self, wanted: FloatArray) -> tuple[FloatArray, int, float, float, float, int]:
        x, y = self.middle
        return np.ascontiguousarray(wanted, np.float64), len(wanted), float(x), float(y), self.size, len(self.told)


def read_modules(image: GreyImage, maps: FloatArray, side: int) -> tuple[FloatArray, FloatArray]:
    """Return the brightness of the modules of N tags, of mean 0 and length 1, (N, side * side), and its standard
    deviation before, (N,).

    `maps` (N, 3, 3) take the unit square to each tag; brightness is bilinear at the middles of `side` x `side` modules,
    that of the border beyond it.
    """
    spread, bright = np.empty(len(maps)), np.empty((len(maps), side * side))
    kernels().read_modules(
        *(*image_arguments(image), np.ascontiguousarray(maps, np.float64), len(maps), side),
        *(bright, spread),
    )
    return bright, spread
