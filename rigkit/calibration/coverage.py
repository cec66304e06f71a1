"""Where in the image boards were: elsewhere a calibration extrapolates."""

from __future__ import annotations

import numpy as np

from rigkit.calibration.result import Calibration
from rigkit.core.arrays import BoolArray, FloatArray, IntArray, Pixels

__all__ = ["covered_by_boards"]

REACH = 1.0
"""A pixel within this many spacings of a corner (of its board in its view) lies on a board: discs of 0.71 would leave
no gap inside a regular grid."""
PART = 65536
"""Distances computed at a time."""


def covered_by_boards(calibration: Calibration, pixels: Pixels) -> BoolArray:
    """Say which of `pixels` (..., 2) lie where boards of the calibration were, (...,)."""
    corners = np.concatenate([view.pixels[view.kept] for view in calibration.views])
    reach = np.concatenate([_spacing(view.grid[view.kept], view.pixels[view.kept]) for view in calibration.views])
    flat = np.reshape(pixels, (-1, 2))
    found = np.zeros(len(flat), dtype=bool)
    step = max(1, PART // max(len(corners), 1))
    for first in range(0, len(flat), step):
        part = slice(first, first + step)
        squared = ((flat[part, None] - corners) ** 2).sum(axis=-1)
        found[part] = (squared <= (REACH * reach) ** 2).any(axis=1)
    return found.reshape(np.shape(pixels)[:-1])


def _spacing(grid: IntArray, pixels: Pixels) -> FloatArray:
    """Return the largest distance of each corner (N,) to its neighbours on the grid, where it has any; else the
    median of the others."""
    table = np.full((int(grid[:, 0].max(initial=0)) + 3, int(grid[:, 1].max(initial=0)) + 3, 2), np.nan)
    column, row = grid.T + 1
    table[column, row] = pixels
    around = [table[column + i, row + j] for i, j in ((1, 0), (-1, 0), (0, 1), (0, -1))]
    distance = np.nan_to_num([np.linalg.norm(there - pixels, axis=1) for there in around]).max(axis=0, initial=0.0)
    usual = float(np.median(distance[distance > 0.0])) if (distance > 0.0).any() else 0.0
    return np.asarray(np.where(distance > 0.0, distance, usual))
