"""What `detection.checks.discontinuity` asks the kernel of splits.c for, in numpy."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rigkit.core.arrays import FloatArray, IntArray, median_of
from rigkit.detection.checks.discontinuity import (
    AS_SMOOTH,
    FLOOR_CELLS,
    JUMP,
    MIN_BESIDE,
    MIN_FREE,
    SURFACE_RIDGE,
    TWO_SURFACES,
    WINDOW,
)

WIDTHS = (1, 0, 2)
"""Columns on the discontinuity, of neither side: where boards touch there is one. The first shows every one, the others
where it is."""

MEETING = np.linspace(0.0, 1.0, 5)
"""Parts of the way from one side to the other where they may meet."""

CUBIC, QUADRATIC = 10, 6
"""Terms of the surfaces."""

DETERMINED_TERMS = np.array([0, 3, 5, 6])
"""Terms of a quadratic surface that 0, 1, 2, and more columns determine."""


class Split(NamedTuple):
    """Columns `start` to `end` (exclusive) of a lattice lie between two boards that fit `ratio` times better alone."""

    ratio: float
    start: int
    end: int
    alone: float = 0.0
    """What the two leave, RMS in cells."""


def clearest_split(pixels: FloatArray, sigma_px: FloatArray, several: bool) -> Split:
    """Return the clearest discontinuity between columns of `pixels` (R, C, 2), of ratio 0 if there is none."""
    sums = _Sums.of(pixels, sigma_px)
    found: list[Split] = []
    for wide in WIDTHS:
        found += _splits(sums, wide, several)
        if not found:
            break
    clearest = max(found, key=lambda split: split.ratio, default=Split(0.0, 0, 0))
    # Corners that either side is as smooth with are not on the discontinuity.
    as_good = [split for split in found if split.alone <= AS_SMOOTH * clearest.alone]
    return min(as_good, key=lambda split: (split.end - split.start, -split.ratio), default=clearest)


def _splits(sums: _Sums, wide: int, several: bool) -> list[Split]:
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
    return [Split(float(ratio[k]), int(start[k]), int(end[k]), float(np.sqrt(alone[k]))) for k in which]


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
