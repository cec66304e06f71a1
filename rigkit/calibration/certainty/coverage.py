"""Where in the image boards were, and how far away: elsewhere a calibration extrapolates."""

from __future__ import annotations

import numpy as np

from rigkit.calibration.result import Calibration
from rigkit.core.arrays import BoolArray, FloatArray, Pixels
from rigkit.kernels.coverage import covered_pixels

REACH = 1.0
"""A pixel within this many spacings of a corner (of its board in its view) lies on a board: discs of 0.71 would leave
no gap inside a regular grid, and perspective makes spacings differ within a view."""


def covered_by_boards(calibration: Calibration, pixels: Pixels) -> BoolArray:
    """Say which of `pixels` (..., 2) lie where boards of the calibration were, (...,)."""
    every, flat = calibration.corners, np.reshape(pixels, (-1, 2))
    kept = every.kept
    counts = np.bincount(every.view[kept])
    found = covered_pixels(every.grid[kept], every.pixels[kept], counts[counts > 0], REACH, flat)
    return found.reshape(np.shape(pixels)[:-1])


def outline_of_corners(calibration: Calibration) -> Pixels:
    """Return the convex outline of all corners used, (N, 2), each of its corners once."""
    from scipy.spatial import ConvexHull

    corners, _ = calibration.corners.used
    # QJ: corners on one line have an outline as well, a thin one.
    return np.asarray(corners[ConvexHull(corners, qhull_options="QJ").vertices])


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
