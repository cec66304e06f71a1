"""Calls of the kernels in five_point.c and six_point.c: essential matrices of many minimal samples."""

from __future__ import annotations

import numpy as np

from rigkit.core.arrays import FloatArray, Mat3
from rigkit.kernels import kernels
from rigkit.kernels.declarations import header

MOST_ROOTS = header().constants["MOST_ROOTS"]


def five_rows(rows: FloatArray) -> Mat3:
    """Return up to ten E (B, 10, 3, 3) of `rows` (B, 5, 9), NaN where there are fewer."""
    rows, out = np.ascontiguousarray(rows, np.float64), np.empty((len(rows), MOST_ROOTS, 3, 3))
    kernels().five_rows(rows, len(rows), out)
    return out


def six_rows(rows: FloatArray) -> Mat3:
    """Return the E (B, 1, 3, 3) of `rows` (B, 6, 9)."""
    rows, out = np.ascontiguousarray(rows, np.float64), np.empty((len(rows), 1, 3, 3))
    kernels().six_rows(rows, len(rows), out)
    return out
