"""Calls of the kernels in minimal.c: essential matrices of many minimal samples."""

from __future__ import annotations

import ctypes
import functools
from ctypes import c_int64, c_void_p

import numpy as np

from rigkit.core.arrays import FloatArray, Mat3
from rigkit.kernels import address, kernels

__all__ = ["five_rows", "loaded", "six_rows"]


@functools.cache
def loaded() -> ctypes.CDLL | None:
    """Return the library, None where the kernels are not to be had."""
    library = kernels("minimal")
    if library is None:
        return None
    for name in ("five_rows", "six_rows"):
        function = getattr(library, name)
        function.argtypes, function.restype = [c_void_p, c_int64, c_void_p], None
    return library


def five_rows(library: ctypes.CDLL, rows: FloatArray) -> Mat3:
    """Return up to ten E (B, 10, 3, 3) of `rows` (B, 5, 9), NaN where there are fewer."""
    rows, out = np.ascontiguousarray(rows, np.float64), np.empty((len(rows), 10, 3, 3))
    library.five_rows(address(rows), len(rows), address(out))
    return out


def six_rows(library: ctypes.CDLL, rows: FloatArray) -> Mat3:
    """Return the E (B, 1, 3, 3) of `rows` (B, 6, 9)."""
    rows, out = np.ascontiguousarray(rows, np.float64), np.empty((len(rows), 1, 3, 3))
    library.six_rows(address(rows), len(rows), address(out))
    return out
