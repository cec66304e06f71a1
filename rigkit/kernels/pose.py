"""Calls of the kernels in pose.c: hypotheses of the relative pose against many matches."""

from __future__ import annotations

import ctypes
import functools
from ctypes import POINTER, Structure, byref, c_double, c_int64, c_void_p
from typing import ClassVar

import numpy as np

from rigkit.core.arrays import FloatArray, IntArray, Mat3
from rigkit.kernels import address, kernels

__all__ = ["improve", "loaded", "minimise", "qualities", "qualities_ahead", "residuals"]

NO_MEMORY = -1000
"""As in pose.c: more than there are iterations."""


class _Problem(Structure):
    """problem_t."""

    _fields_: ClassVar = [
        *((name, c_void_p) for name in ("packed", "affine", "point_weights", "which", "free")),
        *((name, c_int64) for name in ("count", "chosen", "freedom", "loss", "most_iterations")),
        *((name, c_double) for name in ("scale", "tolerance")),
    ]


@functools.cache
def loaded() -> ctypes.CDLL | None:
    """Return the library, None where the kernels are not to be had."""
    library = kernels("pose")
    if library is None:
        return None
    pointer, size = c_void_p, c_int64
    library.residuals.argtypes = [pointer, size, pointer, size, pointer]
    library.qualities.argtypes = [pointer, size, pointer, size, c_double, pointer]
    library.improve.argtypes = [pointer, size, pointer, pointer, c_double, size, pointer, size, size, c_double]
    library.qualities_ahead.argtypes = [pointer, size, pointer, pointer, size, c_double, c_double, pointer]
    for name in ("residuals", "qualities", "qualities_ahead", "improve"):
        getattr(library, name).restype = None
    library.minimise.argtypes, library.minimise.restype = [POINTER(_Problem), *[pointer] * 5], size
    return library


def residuals(library: ctypes.CDLL, packed: FloatArray, E21: Mat3) -> FloatArray:
    """Return the distances (H, N) in sigmas of the matches `packed` (18, N) from hypotheses (H, 3, 3)."""
    E21 = np.ascontiguousarray(E21, np.float64)
    out = np.empty((len(E21), packed.shape[1]))
    library.residuals(address(packed), packed.shape[1], address(E21), len(E21), address(out))
    return out


def qualities(library: ctypes.CDLL, packed: FloatArray, E21: Mat3, noise: float) -> FloatArray:
    """Return the sums (H,) of the marginal qualities of the matches `packed` (18, N) under hypotheses (H, 3, 3)."""
    E21 = np.ascontiguousarray(E21, np.float64)
    out = np.empty(len(E21))
    library.qualities(address(packed), packed.shape[1], address(E21), len(E21), noise, address(out))
    return out


def qualities_ahead(
    library: ctypes.CDLL, packed: FloatArray, R: FloatArray, t: FloatArray, noise: float, sigmas: float
) -> FloatArray:
    """Return the sums (H,) over what lies ahead, of rotations (H, 2, 3, 3) and directions (H, 3); see pose.c."""
    R, t = np.ascontiguousarray(R, np.float64), np.ascontiguousarray(t, np.float64)
    out = np.empty(len(t))
    where = address(packed), packed.shape[1], address(R), address(t)
    library.qualities_ahead(*where, len(t), noise, sigmas, address(out))
    return out


def improve(
    library: ctypes.CDLL,
    packed: FloatArray,
    R: FloatArray,
    t: FloatArray,
    noise: float,
    free: IntArray,
    most_steps: int,
    settled_rad: float,
) -> tuple[FloatArray, FloatArray]:
    """Return the rotations (H, 3, 3) and directions (H, 3) of best quality at a noise level near those given."""
    R, t = np.array(R, np.float64, order="C"), np.array(t, np.float64, order="C")
    free = np.ascontiguousarray(free, np.int64)
    library.improve(
        *(address(packed), packed.shape[1], address(R), address(t), noise, len(R)),
        *(address(free), len(free), most_steps, settled_rad),
    )
    return R, t


def minimise(
    library: ctypes.CDLL,
    packed: FloatArray,
    affine: FloatArray,
    which: IntArray,
    point_weights: FloatArray,
    loss: tuple[int, float],
    free: IntArray,
    R: FloatArray,
    t: FloatArray,
    most_iterations: int,
    tolerance: float,
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray, FloatArray, int, bool]:
    """Return R, t, residuals (M,), Jacobian (M, 5), weights (M,), iterations, and whether the last step was small.

    `affine` (25, K) are the affinities of the matches `which` (K,), see pose.c; `loss` is 0 for none, 1 for Cauchy's
    or 2 for the marginal one, and its scale; `free` which of the five unknowns move.
    """
    kept = [np.ascontiguousarray(a, np.float64) for a in (packed, affine, point_weights)]
    indices = [np.ascontiguousarray(a, np.int64) for a in (which, free)]
    problem = _Problem(
        *(address(array) for array in (*kept, *indices)),
        *(packed.shape[1], len(which), len(free), loss[0], most_iterations),
        *(loss[1], tolerance),
    )
    rows = packed.shape[1] + 2 * len(which)
    R, t = np.array(R, np.float64, order="C"), np.array(t, np.float64)
    r, jacobian, weights = np.empty(rows), np.empty((rows, 5)), np.empty(rows)
    out = (R, t, r, jacobian, weights)
    iterations = library.minimise(byref(problem), *(address(array) for array in out))
    if iterations == NO_MEMORY:
        raise MemoryError
    return *out, abs(iterations), iterations > 0 or not len(free)
