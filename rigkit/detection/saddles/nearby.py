"""Which points have another nearby."""

from __future__ import annotations

import numpy as np

from rigkit.core.arrays import BoolArray, FloatArray
from rigkit.kernels import front


def near_any(points: FloatArray, others: FloatArray, reach_px: float) -> BoolArray:
    """Return which of `points` (N, 2) lie within `reach_px` of any of `others` (M, 2), in the same pixels."""
    if not len(points) or not len(others):
        return np.zeros(len(points), np.bool_)
    return front.near_any(points, others, reach_px)
