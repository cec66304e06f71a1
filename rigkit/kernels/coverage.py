"""The call of the kernel in coverage.c: which pixels of an image boards covered."""

from __future__ import annotations

import numpy as np

from rigkit.core.arrays import BoolArray, IntArray, Pixels
from rigkit.kernels import kernels


def covered_pixels(grid: IntArray, corners: Pixels, counts: IntArray, squares: float, pixels: Pixels) -> BoolArray:
    """Return which of the `pixels` (M, 2) lie within so many `squares` of a corner of a board, (M,).

    Of the `corners` (N, 2), with places (column, row) in their `grid` (N, 2), each view has so many as `counts` (V,)
    says. A square is as long as the longer side of those that the affine map of a view's grid into the image has.
    """
    covered = np.empty(len(pixels), dtype=bool)
    kernels().cover_pixels(grid, corners, len(corners), counts, len(counts), squares, pixels, len(pixels), covered)
    return covered
