"""The kernels in coverage.c and close_pairs.c: the pixels that boards covered, and pairs of close points."""

from __future__ import annotations

import numpy as np

from rigkit.core.arrays import BoolArray, FloatArray, IntArray, Pixels
from rigkit.kernels import kernels

TYPICAL_PARTNERS = 2
"""Number of pairs per point that is allocated first; if there are more, the search is repeated."""


def covered_pixels(grid: IntArray, corners: Pixels, counts: IntArray, squares: float, pixels: Pixels) -> BoolArray:
    """Return which of the `pixels` (M, 2) are within a number of `squares` of a corner of a board, (M,).

    `corners` (N, 2) with (column, row) in their `grid` (N, 2) are given view by view, `counts` (V,) per view. The size
    of a square is the longer side of a cell under the affine map from a view's grid to the image.
    """
    return np.asarray(kernels().cover_pixels(grid, corners, counts, squares, pixels))


def pairs_within(points: FloatArray, reach: float, ends: IntArray) -> IntArray:
    """Return the pairs (P, 2) of points (N, D) that are within `reach` of each other along every axis.

    The partners of a point are sought in the index ranges between the first and second, and the third and fourth, of
    its `ends` (N, 4).
    """
    pairs = np.empty((TYPICAL_PARTNERS * len(points), 2), np.int64)
    found = kernels().close_pairs(points, reach, ends, pairs)
    if found > len(pairs):
        pairs = np.empty((found, 2), np.int64)
        kernels().close_pairs(points, reach, ends, pairs)
    return pairs[:found]
