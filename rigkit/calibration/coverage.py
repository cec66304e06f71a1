"""Where in the image boards were: elsewhere a calibration extrapolates."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from rigkit.calibration.result import Calibration, ViewResult
from rigkit.core.arrays import BoolArray, FloatArray, Pixels

__all__ = ["covered_by_boards"]

REACH = 1.0
"""A pixel within this many spacings of a corner (of its board in its view) lies on a board: discs of 0.71 would leave
no gap inside a regular grid, and perspective makes spacings differ within a view."""
PART = 1 << 20
"""Distances computed at a time."""


def covered_by_boards(calibration: Calibration, pixels: Pixels) -> BoolArray:
    """Say which of `pixels` (..., 2) lie where boards of the calibration were, (...,)."""
    views = [view for view in calibration.views if view.kept.any()]
    flat = np.reshape(pixels, (-1, 2))
    found = np.zeros(len(flat), dtype=bool)
    if not views:
        return found.reshape(np.shape(pixels)[:-1])
    corners = np.concatenate([view.pixels[view.kept] for view in views])
    reach = _reach_px(views, corners)
    # From the middle of the image, in single precision: good to a tenth of a pixel, and twice as fast.
    middle = 0.5 * np.array(calibration.camera.size_px)
    flat, corners = (flat - middle).astype(np.float32), (corners - middle).astype(np.float32)
    # |p - c|^2 <= reach^2 as one matrix product: p . c - (|c|^2 - reach^2) / 2 >= |p|^2 / 2.
    limit = (0.5 * ((corners**2).sum(axis=1) - reach**2)).astype(np.float32)
    step = max(1, PART // len(corners))
    for first in range(0, len(flat), step):
        part = flat[first : first + step]
        found[first : first + step] = (part @ corners.T - limit).max(axis=1) >= 0.5 * (part**2).sum(axis=1)
    return found.reshape(np.shape(pixels)[:-1])


def _reach_px(views: Sequence[ViewResult], corners: Pixels) -> FloatArray:
    """Return for each of the `corners` kept in all views (N, 2), view by view, how far its board's squares reach (N,).

    That is the longer side of a square as an affine map of the grid into the image has it, one map a view.
    """
    count = np.array([int(view.kept.sum()) for view in views])
    start = np.cumsum(count) - count
    grid = np.concatenate([view.grid[view.kept] for view in views]).astype(np.float64)
    design = np.concatenate([np.ones((len(grid), 1)), grid], axis=1)
    normal = np.add.reduceat(design[:, :, None] * design[:, None, :], start)
    moments = np.add.reduceat(design[:, :, None] * corners[:, None, :], start)
    # A single row or column leaves the other side open, which then counts as zero.
    sides = np.linalg.norm((np.linalg.pinv(normal, hermitian=True) @ moments)[:, 1:], axis=-1)
    return np.repeat(REACH * sides.max(axis=1), count)
