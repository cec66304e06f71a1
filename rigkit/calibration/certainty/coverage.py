"""The part of the image that boards covered, and their distances: elsewhere a calibration extrapolates."""

from __future__ import annotations

import numpy as np

from rigkit.calibration.result import Calibration
from rigkit.core.arrays import BoolArray, FloatArray, Pixels
from rigkit.kernels.coverage import covered_pixels

REACH = 1.0
"""A pixel within this many corner spacings of a corner is covered. 0.71 would leave no gap in a regular grid, but
spacings differ within a view by perspective."""


def covered_by_boards(calibration: Calibration, pixels: Pixels) -> BoolArray:
    """Return which of `pixels` (..., 2) boards of the calibration covered, (...,)."""
    every, flat = calibration.corners, np.reshape(pixels, (-1, 2))
    kept = every.kept
    counts = np.bincount(every.view[kept])
    found = covered_pixels(every.grid[kept], every.pixels[kept], counts[counts > 0], REACH, flat)
    return found.reshape(np.shape(pixels)[:-1])


def outline_of_corners(calibration: Calibration) -> Pixels:
    """Return the convex hull of all corners used, (N, 2), each vertex once."""
    from scipy.spatial import ConvexHull

    corners, _ = calibration.corners.used
    # QJ joggles the input: collinear corners have a thin hull.
    return np.asarray(corners[ConvexHull(corners, qhull_options="QJ").vertices])


def corner_ranges(calibration: Calibration) -> FloatArray:
    """Return the distances of all corners of the boards from the camera, in every view, (N,) mm."""
    corners, shown = calibration.corners, np.array([view.board_id for view in calibration.views])
    found = []
    for board in calibration.boards:
        views = np.flatnonzero(shown == board.board_id)
        places = board.points_mm @ np.swapaxes(corners.rotation[views], 1, 2) + corners.translation_mm[views, None]
        found.append(np.linalg.norm(places, axis=-1).ravel())
    return np.concatenate(found)
