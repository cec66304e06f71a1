"""The kernels in surface.c and codes.c: the map from a board's plane to an image, and the modules of tags."""

from __future__ import annotations

from bisect import bisect_right
from dataclasses import dataclass

import numpy as np

from rigkit.core.arrays import BoolArray, FloatArray, GreyImage, IntArray
from rigkit.kernels import kernels
from rigkit.kernels.declarations import header

_CONSTANTS = header().constants
SIDES, SECOND, GAIN, CURVATURE, HEIGHTS, SURFACE_COLUMNS = (
    _CONSTANTS[name] for name in ("SIDES", "SECOND", "GAIN", "CURVATURE", "HEIGHTS", "SURFACE_COLUMNS")
)
SURFACE_DEGREE = _CONSTANTS["SURFACE_DEGREE"]
"""Largest degree of the polynomial that models distortion in addition to a perspective: a board that fills a fisheye of
180 degrees needs degree 7."""

TERMS_OF_DEGREE = tuple((degree + 1) * (degree + 2) // 2 for degree in range(SURFACE_DEGREE + 1))
"""Number of terms x^i y^j up to a degree."""

HARDLY_MORE = 1.25
"""Largest ratio of the prediction error of the chosen degree to the smallest one. Higher degrees improve less than the
scatter of the points, but the 8th, with an error a tenth smaller than that of the 3rd, bends lines at the rim by up to
8 px within a window (REAL)."""


def perspective(places: FloatArray, pixels: FloatArray) -> tuple[FloatArray, float]:
    """Return the least squares homography (3, 3) from `places` (N, 2) to `pixels` (N, 2), with depth 1 at their mean,
    and the smallest depth of a place (Hartley and Zisserman, Multiple View Geometry, 2004, algorithm 4.2)."""
    depth, homography = kernels().fit_perspective(places, pixels)
    return homography, depth


@dataclass(frozen=True, eq=False, slots=True)
class TagSurface:
    """A map from a board's plane to an image at M places.

    Attributes
    ----------
    rows : (M, SURFACE_COLUMNS) the following properties as columns.
    """

    rows: FloatArray

    @classmethod
    def made_of(cls, pixels: FloatArray, sides: FloatArray, curvatures: FloatArray) -> TagSurface:
        """Return the map with these properties, without those that `Polynomials.added_to` computes."""
        rows = np.zeros((len(pixels), SURFACE_COLUMNS))
        rows[:, :SIDES], rows[:, SIDES:SECOND] = pixels, sides.reshape(-1, 4)
        rows[:, SECOND:GAIN] = curvatures.reshape(-1, 4)
        return cls(rows)

    @property
    def pixels(self) -> FloatArray:
        """(M, 2)"""
        return self.rows[:, :SIDES]

    @property
    def sides(self) -> FloatArray:
        """(M, 2, 2) first derivatives along x and along y, px per unit of the board."""
        return self.rows[:, SIDES:SECOND].reshape(-1, 2, 2)

    @property
    def curvatures(self) -> FloatArray:
        """(M, 2, 2) second derivatives likewise."""
        return self.rows[:, SECOND:GAIN].reshape(-1, 2, 2)

    @property
    def gain(self) -> FloatArray:
        """(M,) standard deviation of `pixels` for points of standard deviation 1, 0 if not computed."""
        return self.rows[:, GAIN]

    @property
    def curvature(self) -> FloatArray:
        """(M, 2) of the lines along x and along y, 1/px, positive towards +90 degrees."""
        return self.rows[:, CURVATURE:HEIGHTS]

    @property
    def heights(self) -> FloatArray:
        """(M, 2) distance of a unit of the board from the line along x, and from that along y, px."""
        return self.rows[:, HEIGHTS:]

    @property
    def seen(self) -> BoolArray:
        """(M,) whether the place is visible, with known derivatives."""
        # A sum is finite if all terms are; all(axis=1) takes eight times as long.
        return np.isfinite(self.rows[:, :SECOND] @ np.ones(SECOND))

    @property
    def lengths(self) -> FloatArray:
        """(M, 2) of the sides."""
        return np.hypot(self.rows[:, SIDES:SECOND:2], self.rows[:, SIDES + 1 : SECOND : 2])

    @property
    def height(self) -> FloatArray:
        """(M,) the smaller of the heights; min(axis=1) takes ten times as long."""
        return np.minimum(self.rows[:, HEIGHTS], self.rows[:, HEIGHTS + 1])

    def of(self, which: BoolArray) -> TagSurface:
        """Return the places `which` (M,)."""
        return TagSurface(self.rows[which])


def projected(homography: FloatArray, places: FloatArray) -> TagSurface:
    """Return the map of a homography (3, 3) at `places` (M, 2), without curvatures and heights."""
    return TagSurface(kernels().project_places(places, homography))


def _empty_triangle(max_terms: int) -> FloatArray:
    """Return the memory (T, T) for the triangle of a polynomial of complete degree with at most `max_terms` terms."""
    terms = TERMS_OF_DEGREE[bisect_right(TERMS_OF_DEGREE, max_terms) - 1]
    return np.zeros((terms, terms))


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class Polynomials:
    """Polynomials of every degree through N points, in T terms x^i y^j.

    Attributes
    ----------
    unit : (3,) centre of the points and half the longer side of their bounding box, which normalise places.
    triangle : (T, T) and basis_values : (T, 2), the QR decomposition of the terms at the points, and the values in its
        basis; the diagonal is 0 for a term that depends on the others at these points.
    misses : (D,) typical leave-one-out errors by degree; infinite for degrees that were not tried, with too few points,
        or from degree 6 on if the two lower degrees gave no improvement.
    plain : the lowest degree whose error is at most HARDLY_MORE times the smallest: further terms fit noise.
    off : (N,) leave-one-out errors of the points for the best degree, and gain : (N,) of these predictions.
    scatter : the median of `off` over hypot(1, gain).
    """

    unit: FloatArray
    triangle: FloatArray
    basis_values: FloatArray
    misses: FloatArray
    plain: int
    off: FloatArray
    gain: FloatArray
    scatter: float

    @classmethod
    def through(cls, places: FloatArray, values: FloatArray, max_terms: int, max_leverage: float) -> Polynomials:
        """Return the polynomials through `values` (N, 2) at `places` (N, 2), with at most `max_terms` terms."""
        triangle = _empty_triangle(max_terms)
        best, unit, *fitted = kernels().fit_polynomials(places, values, max_leverage, triangle)
        return cls._of(best, unit, triangle, *fitted)

    @classmethod
    def beside_perspective(
        cls, places: FloatArray, pixels: FloatArray, max_terms: int, max_leverage: float, nearest: float
    ) -> tuple[FloatArray, Polynomials] | None:
        """Return the `perspective` from `places` (N, 2) to `pixels` (N, 2), and polynomials through its residuals; None
        if the depth of a place is less than `nearest`."""
        triangle = _empty_triangle(max_terms)
        best, homography, unit, *fitted = kernels().fit_map(places, pixels, max_leverage, nearest, triangle)
        return None if best < 0 else (homography, cls._of(best, unit, triangle, *fitted))

    @classmethod
    def _of(
        cls,
        best: int,
        unit: FloatArray,
        triangle: FloatArray,
        basis_values: FloatArray,
        misses: FloatArray,
        off: FloatArray,
        gain: FloatArray,
        scatter: FloatArray,
    ) -> Polynomials:
        plain = int((misses <= HARDLY_MORE * misses[best]).argmax())
        return cls(
            unit=unit,
            triangle=triangle,
            basis_values=basis_values,
            misses=misses,
            plain=plain,
            off=off,
            gain=gain,
            scatter=float(scatter[0]),
        )

    def added_to(self, base: TagSurface | None, wanted: FloatArray, *, most_certain: bool) -> TagSurface:
        """Return the map `base` (None: zero) at `wanted` (M, 2) with the values and derivatives of the plain degree
        added.

        With `most_certain`, the values are those of the degree with the smallest product of typical error and gain at
        each place, and gains are computed: high degrees diverge beyond the points.
        """
        out = np.zeros((len(wanted), SURFACE_COLUMNS)) if base is None else base.rows.copy()
        kernels().add_polynomial(
            wanted, self.unit, self.plain, self.triangle, self.basis_values, self.misses, most_certain, out
        )
        return TagSurface(out)


def maps_of_quads(quads: FloatArray) -> FloatArray:
    """Return the homographies (N, 3, 3) of the unit square, corners (0,0) (1,0) (1,1) (0,1), to the quads (N, 4, 2)."""
    return np.asarray(kernels().maps_of_quads(quads))


def read_modules(image: GreyImage, quads: FloatArray, side: int) -> tuple[FloatArray, FloatArray]:
    """Return the brightness of the modules of N tags, of mean 0 and length 1, (N, side * side), and its standard
    deviation before, (N,).

    `quads` (N, 4, 2) are the corners of each tag; brightness is bilinear at the middles of `side` x `side` modules,
    that of the border beyond it.
    """
    read: tuple[FloatArray, FloatArray] = kernels().read_modules(image, quads, side)
    return read


def read_codes(
    image: GreyImage, quads: FloatArray, side: int, patterns: FloatArray, min_contrast: float
) -> tuple[IntArray, FloatArray]:
    """Return the pattern of `patterns` (C, side * side) with the largest correlation with the modules of N tags, (N,),
    and the correlation, (N,); 0 and 0 if the standard deviation of their brightness is below `min_contrast`. Otherwise
    as `read_modules`."""
    read: tuple[IntArray, FloatArray] = kernels().read_codes(image, quads, side, patterns, min_contrast)
    return read
