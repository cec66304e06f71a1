"""Where in the image boards were, and how far away: elsewhere a calibration extrapolates."""

from __future__ import annotations

import numpy as np

from rigkit.calibration.result import Calibration
from rigkit.core.arrays import BoolArray, FloatArray, IntArray, Pixels

REACH = 1.0
"""A pixel within this many spacings of a corner (of its board in its view) lies on a board: discs of 0.71 would leave
no gap inside a regular grid, and perspective makes spacings differ within a view."""
PIXELS_AT_A_TIME = 256
ONE_LINE = 1e-9
"""Determinant of a grid's scatter, as a part of its squared trace, of a single row or column."""
CORNERS_OF_PART = 512
"""Distances of so many pixels to so many corners are one product that stays in the cache, too small for threads."""


def covered_by_boards(calibration: Calibration, pixels: Pixels) -> BoolArray:
    """Say which of `pixels` (..., 2) lie where boards of the calibration were, (...,)."""
    every = calibration.corners
    flat = np.reshape(pixels, (-1, 2))
    found = np.zeros(len(flat), dtype=bool)
    if not every.kept.any():
        return found.reshape(np.shape(pixels)[:-1])
    corners = every.pixels[every.kept]
    reach = _reach_px(every.view[every.kept], every.grid[every.kept], corners)
    # From the middle of the image, in single precision: good to a tenth of a pixel, and twice as fast.
    middle = 0.5 * np.array(calibration.camera.size_px)
    flat, corners = (flat - middle).astype(np.float32), (corners - middle).astype(np.float32)
    # |p - c|^2 <= reach^2 as one matrix product: p . c - (|c|^2 - reach^2) / 2 >= |p|^2 / 2.
    limit = (0.5 * ((corners**2).sum(axis=1) - reach**2)).astype(np.float32)
    half = 0.5 * (flat**2).sum(axis=1)
    # Each part has corners of all views: most of what is covered at all is covered by the first.
    count = -(-len(corners) // CORNERS_OF_PART)
    order = np.concatenate([np.arange(k, len(corners), count) for k in range(count)])
    corners, limit = np.ascontiguousarray(corners[order].T), limit[order]
    for first in range(0, len(flat), PIXELS_AT_A_TIME):
        left, begin = np.arange(first, min(first + PIXELS_AT_A_TIME, len(flat))), 0
        while left.size and begin < len(order):
            part = slice(begin, begin + CORNERS_OF_PART * PIXELS_AT_A_TIME // len(left))
            there = (flat[left] @ corners[:, part] - limit[part]).max(axis=1) >= half[left]
            found[left[there]] = True
            left, begin = left[~there], part.stop
    return found.reshape(np.shape(pixels)[:-1])


def outline_of_corners(calibration: Calibration) -> Pixels:
    """Return the convex outline of all corners used, (N, 2), each of its corners once."""
    from scipy.spatial import ConvexHull

    corners = calibration.corners.pixels[calibration.corners.kept]
    # QJ: corners on one line have an outline as well, a thin one.
    return np.asarray(corners[ConvexHull(corners, qhull_options="QJ").vertices])


def _reach_px(view: IntArray, grid: IntArray, corners: Pixels) -> FloatArray:
    """Return for each of the `corners` (N, 2), view by view, how far its board's squares reach (N,).

    That is the longer side of a square as an affine map of the grid into the image has it, one map a view.
    """
    count = np.bincount(view)
    count = count[count > 0]
    start = np.cumsum(count) - count
    values = np.concatenate([grid, corners], axis=1)
    values -= np.repeat(np.add.reduceat(values, start) / count[:, None], count, axis=0)
    x, y, u, v = values.T
    xx, xy, yy, xu, yu, xv, yv = np.add.reduceat([x * x, x * y, y * y, x * u, y * u, x * v, y * v], start, axis=1)
    # A single row or column leaves the other side open, which then counts as zero: the pseudo-inverse of rank one.
    size, whole = xx + yy, xx * yy - xy * xy
    flat = whole <= ONE_LINE * size**2
    whole = np.where(flat, np.maximum(size, 1.0) ** 2, whole)
    xx, xy, yy = np.where(flat, [yy, -xy, xx], [xx, xy, yy])
    sides = np.hypot([yy * xu - xy * yu, xx * yu - xy * xu], [yy * xv - xy * yv, xx * yv - xy * xv]) / whole
    return np.repeat(REACH * sides.max(axis=0), count)


def corner_ranges(calibration: Calibration) -> FloatArray:
    """Return the distances of all corners of the boards from the camera, in every view, (N,) mm."""
    corners, shown = calibration.corners, np.array([view.board_id for view in calibration.views])
    found = []
    for board in calibration.boards:
        views = np.flatnonzero(shown == board.board_id)
        rotation, shift = corners.rotation[views], corners.translation_mm[views]
        # |R X + t|^2 = |X|^2 + 2 X . R^T t + |t|^2.
        squared = board.points_mm @ (2.0 * (shift[:, None] @ rotation)[:, 0]).T
        squared += (board.points_mm**2).sum(axis=1)[:, None] + (shift**2).sum(axis=1)
        found.append(np.sqrt(np.maximum(squared, 0.0)).ravel())
    return np.concatenate(found)
