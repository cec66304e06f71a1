"""The call of the kernel in close_pairs.c: which points lie close to each other."""

from __future__ import annotations

import numpy as np

from rigkit.core.arrays import FloatArray, IntArray
from rigkit.kernels import kernels

USUAL_PARTNERS = 2
"""Room for so many pairs a point at first; where there are more of them, they are sought again."""


def pairs_within(points: FloatArray, reach: float, ends: IntArray) -> IntArray:
    """Return the pairs (P, 2) of points (N, D) that are within `reach` of each other along every axis; the partners of
    each are sought between the first and the second, and the third and the fourth of its `ends` (N, 4)."""
    pairs = np.empty((USUAL_PARTNERS * len(points), 2), np.int64)
    found = kernels().close_pairs(points, *points.shape, reach, ends, pairs, len(pairs))
    if found > len(pairs):
        pairs = np.empty((found, 2), np.int64)
        kernels().close_pairs(points, *points.shape, reach, ends, pairs, len(pairs))
    return pairs[:found]
