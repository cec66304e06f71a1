"""Boards that touch or overlap so nearly in line that one lattice goes on from one to the next.

Where their borders meet there are corners that look like a chessboard's and are none, or lie where the two boards have
them, by hundredths of a square beside where either of them would. So what the edge model fits badly is held against
where the other corners have it; and a lattice whose two sides are each a smooth surface, but not the same one, is cut.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rigkit.core.arrays import BoolArray, FloatArray, IntArray, median_of, upper_median
from rigkit.detection.checks.validate import stray_row
from rigkit.detection.lattice.local_fit import PLIANT, STIFF, fit_cells
from rigkit.detection.subpixel.refined import RefinedLattice

SUSPECT_FACTOR = 2.0
"""A corner whose residual, relative to its contrast, exceeds the typical one of the board by this factor is suspect:
chance makes 1.15, the rim of a fisheye at most 3; squares that are not one board's make 2 to 20."""

OUTLIER_FACTOR = 8.0
"""A suspect is dropped that lies further from where the others have it than this times what is typical of the board and
good to expect of the prediction. By the more pliant of the predictions alone that is 7 of 2302 suspects in pictures of
single boards, half of them real, and 220 of 252 on the borders of boards that overlap: the rest lie in line with a row.
"""

MIN_OUTLIER_SIGMAS = 5.0
"""And by more than so many of its own standard deviations: what is uncertain may lie aside."""

IN_PLACE = 3.0
"""A suspect nearer than this, in the same units, to either of the predictions is none."""

MIN_SUSPECT_RESIDUAL = 0.02
"""Residual relative to the contrast below which nothing is suspect: rounding and compression are uneven, too."""

MIN_JUDGES = 8
"""Corners behind a prediction that convicts."""

UNUSUAL, MIN_UNUSUAL = 1.3, 3
"""A discontinuity shows: so many corners have residuals beyond this times the typical one."""

WINDOW = 5
"""Columns to either side of a discontinuity that are looked at."""

WIDTHS = (1, 0, 2)
"""Columns on the discontinuity, of neither side: where boards touch there is one. The first shows every one, the others
where it is."""

TWO_SURFACES = 2.5
"""Two quadratic surfaces, one on each side, leave so many times less than one cubic surface through both where they are
two boards. In 248 lattices of single boards, up to the rims of fisheyes, at most 1.8 times."""

JUMP, MEETING = 0.02, np.linspace(0.0, 1.0, 5)
"""Seen from both sides the discontinuity is so wide, in cells: at a crease of the paper the sides meet. It is anywhere
between the columns, and looked for in these parts of the way."""

FLOOR_CELLS = 1e-3
"""No printed board is truer than this."""

MIN_BESIDE, MIN_FREE = 5, 6
"""Corners on each side of a discontinuity, and in all beyond what the surfaces take up."""

AS_SMOOTH = 1.3
"""What the two sides leave at the clearest discontinuity and, at most, at a narrower one that is taken for it."""

SURFACE_RIDGE = 1e-9
"""On normal equations of terms of about 1: what too few columns leave open stays 0."""

CUBIC, QUADRATIC = 10, 6
"""Terms of the surfaces."""

DETERMINED_TERMS = np.array([0, 3, 5, 6])
"""Terms of a quadratic surface that 0, 1, 2, and more columns determine."""


def may_be_discontinuous(item: RefinedLattice, size_px: tuple[int, int]) -> bool:
    """Return whether `item` may have a discontinuity; a quick look. `size_px` is the (width, height) of the image.

    Corners on a discontinuity fit badly, and where boards are not side by side, corners are missing that the frame
    does not cut off.
    """
    known = item.lattice.known
    relative = np.sort(item.residual[known] / item.lattice.contrast[known])
    if len(relative) > MIN_UNUSUAL and float(relative[-MIN_UNUSUAL]) > UNUSUAL * float(relative[len(relative) // 2]):
        return True
    if known.all():
        return False
    missing = fit_cells(item.lattice.pixels, ~known, degree=1).pixels
    inside = ((missing > 0.0) & (missing < np.array(size_px) - 1.0)).all(axis=1)
    return int(np.count_nonzero(inside)) >= MIN_UNUSUAL


def without_outliers(item: RefinedLattice, size_px: tuple[int, int]) -> RefinedLattice:
    """Return `item` without corners that fit badly and are not where the others have them, trimmed.

    What these, and the fit, leave of a row that has strayed into it goes with them. `size_px` is the (width, height) of
    the image.
    """
    return _tidied(_without_astray(item), size_px)


def _tidied(item: RefinedLattice, size_px: tuple[int, int]) -> RefinedLattice:
    stray = stray_row(item.lattice, size_px)
    while stray is not None:
        item = item.without(stray)
        item = item.cut(*item.lattice.extent)
        stray = stray_row(item.lattice, size_px)
    return item


def _without_astray(item: RefinedLattice) -> RefinedLattice:
    known = item.lattice.known
    relative = np.zeros(known.shape)
    relative[known] = item.residual[known] / item.lattice.contrast[known]
    typical = upper_median(relative[known])
    suspect = relative > max(SUSPECT_FACTOR * typical, MIN_SUSPECT_RESIDUAL)
    judges = known & ~suspect
    if not suspect.any() or np.count_nonzero(judges) < MIN_JUDGES:
        return item
    pixels = item.lattice.without(suspect).pixels
    usual = fit_cells(pixels, judges, leave_out=True)
    expected = upper_median(np.hypot(*(usual.pixels - pixels[judges]).T) / usual.cell_px())
    outlying, in_place = _judged(item, suspect, expected)
    # Under the edge of a shadow whole rows are suspect: those that are in place say where the rows beyond them are.
    while outlying.any() and in_place.any():
        suspect = suspect & ~in_place
        outlying, in_place = _judged(item, suspect, expected)
    if not outlying.any():
        return item
    item = item.without(outlying)
    return item.cut(*item.lattice.extent)


def _judged(item: RefinedLattice, suspect: BoolArray, expected: float) -> tuple[BoolArray, BoolArray]:
    """Return which of the `suspect` corners (R, C) are not where the others have them, and which clearly are.

    The others are mostly as good as `expected`, in cells.
    """
    pixels = item.lattice.without(suspect).pixels
    outlying, in_place = np.zeros((2, *suspect.shape), np.bool_)
    outlying[suspect] = True
    # Both must agree.
    for degree, ridge in (STIFF, PLIANT):
        shape = fit_cells(pixels, suspect, degree=degree, ridge=ridge)
        off = np.hypot(*(shape.pixels - item.lattice.pixels[suspect]).T)
        good = expected * np.hypot(1.0, shape.gain) * shape.cell_px()
        judged = shape.support >= MIN_JUDGES
        outlying[suspect] &= judged & (
            off > np.maximum(OUTLIER_FACTOR * good, MIN_OUTLIER_SIGMAS * item.sigma_px[suspect])
        )
        in_place[suspect] |= judged & (off < IN_PLACE * good)
    return outlying, in_place


def split_at_discontinuities(item: RefinedLattice, *, several: bool = False) -> list[RefinedLattice]:
    """Return the boards that `item` is made of, without the corners where they touch.

    several : it is known to be more than one, so the clearest discontinuity is one, however well the two go together.
    """
    if item.lattice.count < 2 * MIN_BESIDE + MIN_FREE:
        return [item]
    across = _clearest_split(item.lattice.pixels, item.sigma_px, several)
    down = _clearest_split(item.lattice.pixels.swapaxes(0, 1), item.sigma_px.T, several)
    every, best = slice(0, None), max(across, down, key=lambda split: split.ratio)
    if best.ratio == 0.0:
        return [item]
    sides = (slice(0, best.start), slice(best.end, None))
    cuts = [(every, side) if best is across else (side, every) for side in sides]
    return [part for cut in cuts for part in split_at_discontinuities(item.cut(*cut))]


class _Split(NamedTuple):
    """Columns `start` to `end` (exclusive) of a lattice lie between two boards that fit `ratio` times better alone."""

    ratio: float
    start: int
    end: int
    alone: float = 0.0
    """What the two leave, RMS in cells."""


def _clearest_split(pixels: FloatArray, sigma_px: FloatArray, several: bool) -> _Split:
    """Return the clearest discontinuity between columns of `pixels` (R, C, 2), of ratio 0 if there is none."""
    sums = _Sums.of(pixels, sigma_px)
    found: list[_Split] = []
    for wide in WIDTHS:
        found += _splits(sums, wide, several)
        if not found:
            break
    clearest = max(found, key=lambda split: split.ratio, default=_Split(0.0, 0, 0))
    # Corners that either side is as smooth with are not on the discontinuity.
    as_good = [split for split in found if split.alone <= AS_SMOOTH * clearest.alone]
    return min(as_good, key=lambda split: (split.end - split.start, -split.ratio), default=clearest)


def _splits(sums: _Sums, wide: int, several: bool) -> list[_Split]:
    """Return the discontinuities that `wide` columns may lie on; `sums` are over the first columns."""
    columns, rows = len(sums.values) - 1, sums.in_row.shape[1]
    start = np.arange(1, columns - wide)
    end = start + wide
    left = sums.between(np.maximum(0, start - WINDOW), start)
    right = sums.between(end, np.minimum(columns, end + WINDOW))
    both = _Sums(left.values + right.values)
    taken, corners = left.determined() + right.determined(), both.corners
    possible = (np.minimum(left.corners, right.corners) >= MIN_BESIDE) & (corners - taken >= MIN_FREE)
    if not possible.any():
        return []
    together = both.fitted(CUBIC)[1] / np.maximum(corners - CUBIC, 1)
    floor = both.variance / np.maximum(corners, 1) + FLOOR_CELLS**2
    if not several and not (possible & (together > TWO_SURFACES**2 * floor)).any():
        return []
    one, apart1 = left.fitted(QUADRATIC)
    two, apart2 = right.fitted(QUADRATIC)
    alone = (apart1 + apart2) / np.maximum(corners - taken, 1) + floor
    ratio = np.sqrt(together / alone)
    if not several and not (possible & (ratio > TWO_SURFACES)).any():
        return []
    # How far apart the sides have rows that they share, anywhere from the last column of one to the first of the other.
    between = start + MEETING[:, None] * (wide + 1) - 1.0
    terms = _terms(_scaled(between, columns)[..., None], _scaled(np.arange(rows), rows))[..., :QUADRATIC]
    off = ((terms @ (one - two)) ** 2).sum(axis=3)
    common = (left.in_row > 0) & (right.in_row > 0)
    jump = np.where(common, off, 0.0).sum(axis=2).min(axis=0) / np.maximum(common.sum(axis=1), 1)
    # Where they share none they are far apart in any case.
    two_sheets = (ratio > TWO_SURFACES) & ((jump > JUMP**2) | ~common.any(axis=1))
    which = np.flatnonzero(possible & (two_sheets | several))
    return [_Split(float(ratio[k]), int(start[k]), int(end[k]), float(np.sqrt(alone[k]))) for k in which]


@dataclass(frozen=True, eq=False, slots=True)
class _Sums:
    """What a polynomial surface through the corners of some columns is made of, in cells; M sets of columns.

    Attributes
    ----------
    values : (M, 123 + R), read by the properties: all are sums, and added and subtracted together.
    """

    values: FloatArray

    @classmethod
    def of(cls, pixels: FloatArray, sigma_px: FloatArray) -> _Sums:
        """Return the sums over the first 0, 1, .. C columns."""
        known = np.isfinite(pixels[..., 0])
        rows, columns = known.shape
        steps = np.concatenate([np.diff(pixels, axis=axis).reshape(-1, 2) for axis in (0, 1)])
        lengths = np.hypot(steps[:, 0], steps[:, 1])
        seen = lengths[np.isfinite(lengths)]
        cell_px = median_of(seen) if seen.size else np.nan
        middle = pixels[known].mean(axis=0)
        place = np.where(known[..., None], (pixels - middle) / cell_px, 0.0).swapaxes(0, 1)
        terms = _terms(_scaled(np.arange(columns), columns)[:, None], _scaled(np.arange(rows), rows))
        terms = np.where(known.T[..., None], terms, 0.0)
        across = terms.swapaxes(1, 2)
        values = np.zeros((columns + 1, CUBIC * CUBIC + 2 * CUBIC + 3 + rows))
        sums, there = cls(values), cls(values[1:])
        there.normal[:], there.right[:] = across @ terms, across @ place
        there.square[:] = (place**2).sum(axis=(1, 2))
        there.variance[:] = (np.where(known, sigma_px / cell_px, 0.0) ** 2).sum(axis=0)
        there.columns[:], there.in_row[:] = known.any(axis=0), known.T
        values.cumsum(axis=0, out=values)
        return sums

    @property
    def normal(self) -> FloatArray:
        """(M, 10, 10) matrices of the normal equations."""
        return self.values[:, : CUBIC * CUBIC].reshape(-1, CUBIC, CUBIC)

    @property
    def right(self) -> FloatArray:
        """(M, 10, 2) their right sides."""
        return self.values[:, CUBIC * CUBIC : CUBIC * CUBIC + 2 * CUBIC].reshape(-1, CUBIC, 2)

    @property
    def square(self) -> FloatArray:
        """(M,) sums of the squares of the positions."""
        return self.values[:, CUBIC * CUBIC + 2 * CUBIC]

    @property
    def variance(self) -> FloatArray:
        """(M,) sums of the corners' variances per axis."""
        return self.values[:, CUBIC * CUBIC + 2 * CUBIC + 1]

    @property
    def columns(self) -> FloatArray:
        """(M,) columns that have corners."""
        return self.values[:, CUBIC * CUBIC + 2 * CUBIC + 2]

    @property
    def in_row(self) -> FloatArray:
        """(M, R) corners in each row."""
        return self.values[:, CUBIC * CUBIC + 2 * CUBIC + 3 :]

    @property
    def corners(self) -> FloatArray:
        return np.asarray(self.in_row.sum(axis=1))

    def between(self, first: IntArray, end: IntArray) -> _Sums:
        """Return those over the columns `first` to `end` (exclusive), (M,) each."""
        return _Sums(self.values[end] - self.values[first])

    def determined(self) -> IntArray:
        """Return how many terms of a quadratic surface the columns determine, (M,)."""
        return np.asarray(DETERMINED_TERMS[np.minimum(self.columns, 3.0).astype(np.int64)], dtype=np.int64)

    def fitted(self, terms: int) -> tuple[FloatArray, FloatArray]:
        """Return the surfaces (M, terms, 2) of the first so many terms and the mean square that they leave, times N."""
        normal = self.normal[:, :terms, :terms] + SURFACE_RIDGE * np.eye(terms)
        right = self.right[:, :terms]
        surface = np.asarray(np.linalg.solve(normal, right), dtype=np.float64)
        return surface, np.maximum(0.5 * (self.square - (right * surface).sum(axis=(1, 2))), 0.0)


def _scaled(number: NDArray[np.floating | np.integer], count: int) -> FloatArray:
    """Return rows or columns, of `count`, as numbers around 0 that are small where surfaces are fitted."""
    return np.asarray((number - 0.5 * (count - 1.0)) / WINDOW)


def _terms(x: FloatArray, y: FloatArray) -> FloatArray:
    """Return the terms (..., 10) of a cubic surface."""
    xx, xy, yy = x * x, x * y, y * y
    terms = np.empty((*xy.shape, CUBIC))
    for k, term in enumerate((1.0, x, y, xx, xy, yy, xx * x, xx * y, x * yy, yy * y)):
        terms[..., k] = term
    return terms
