"""The kernels in coverage.c and close_pairs.c: which pixels boards covered, and which points lie close together."""

from __future__ import annotations

import numpy as np

from rigkit.core.arrays import BoolArray, FloatArray, IntArray, Pixels
from rigkit.kernels import kernels

TYPICAL_PARTNERS = 2
"""Room for so many pairs a point at first; where there are more of them, they are sought again."""


def covered_pixels(grid: IntArray, corners: Pixels, counts: IntArray, squares: float, pixels: Pixels) -> BoolArray:
    """Return which of the `pixels` (M, 2) lie within so many `squares` of a corner of a board, (M,).

    Of the `corners` (N, 2), with places (column, row) in their `grid` (N, 2), each view has so many as `counts` (V,)
    says. A square is as long as the longer side of those that the affine map of a view's grid into the image has.
    """
    return np.asarray(kernels().cover_pixels(grid, corners, counts, squares, pixels))


def pairs_within(points: FloatArray, reach: float, ends: IntArray) -> IntArray:
    """Return the pairs (P, 2) of points (N, D) that are within `reach` of each other along every axis; the partners of
    each are sought between the first and the second, and the third and the fourth of its `ends` (N, 4)."""
    pairs = np.empty((TYPICAL_PARTNERS * len(points), 2), np.int64)
    found = kernels().close_pairs(points, reach, ends, pairs)
    if found > len(pairs):
        pairs = np.empty((found, 2), np.int64)
        kernels().close_pairs(points, reach, ends, pairs)
    return pairs[:found]
