"""Calls of the kernels in lattice.c: plain arrays in, plain arrays out; all tolerances come from the callers."""

from __future__ import annotations

import ctypes
import functools
from collections.abc import Sequence
from ctypes import POINTER, Structure, byref, c_double, c_int64, c_void_p
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from rigkit.core.arrays import FloatArray
from rigkit.kernels import address, kernels

__all__ = ["ScatterRules", "excess_scatter", "loaded", "shifts_of_edges", "uneven_steps"]

ROOM_FOR_SCATTER = 7
"""Numbers that lattice.c keeps for each corner."""


class ScatterRules(Structure):
    """scatter_rules_t."""

    _fields_: ClassVar = [
        *((name, c_double) for name in ("unexplained", "median_of_normal")),
        *((name, c_int64) for name in ("fewest_corners", "fewest_differences", "first_order", "last_order")),
    ]


@functools.cache
def loaded() -> ctypes.CDLL | None:
    """Return the library with its arguments declared, None where there is none."""
    library = kernels("lattice")
    if library is not None:
        library.uneven_steps.argtypes = [c_void_p, c_int64, c_int64, *[c_void_p] * 4]
        library.uneven_steps.restype = None
        library.excess_scatter.argtypes = [
            *(c_void_p, c_void_p, c_int64, c_void_p, c_int64),
            *(POINTER(ScatterRules), c_void_p, c_void_p),
        ]
        library.excess_scatter.restype = None
        library.edge_shifts.argtypes = [
            *(c_void_p, c_int64, c_int64, c_double),
            *(c_void_p, c_int64, c_int64, c_double, c_double),
            *(c_double, c_void_p, c_int64, c_int64, c_int64, c_void_p, c_void_p),
        ]
        library.edge_shifts.restype = None
    return library


def uneven_steps(library: ctypes.CDLL, pixels: FloatArray) -> tuple[list[float], list[int], tuple[float, float]]:
    """Return what `detection.lattice.spacing.unevenness` does of `pixels` (R, C, 2).

    That is `typical` and `seen` of the inner columns and then of the inner rows, and `every` of both.
    """
    pixels = np.ascontiguousarray(pixels, np.float64)
    rows, columns = pixels.shape[:2]
    inner = max(columns - 2, 0) + max(rows - 2, 0)
    numbers, seen = np.empty(2 * rows * columns + inner + 2), np.empty(inner, np.int64)
    start = address(numbers)
    typical = start + 16 * rows * columns
    library.uneven_steps(address(pixels), rows, columns, start, typical, address(seen), typical + 8 * inner)
    *uneven, along_rows, along_columns = numbers[2 * rows * columns :].tolist()
    return uneven, seen.tolist(), (along_rows, along_columns)


def excess_scatter(
    library: ctypes.CDLL,
    pixels: FloatArray,
    sigma_px: FloatArray,
    parts: Sequence[tuple[slice, slice]],
    rules: ScatterRules,
) -> FloatArray:
    """Return what `subpixel.scatter.excess_scatter` does of `pixels` (R, C, 2) and `sigma_px` (R, C), (P,)."""
    pixels, sigma_px = np.ascontiguousarray(pixels, np.float64), np.ascontiguousarray(sigma_px, np.float64)
    where = np.array(
        [(rows.start, columns.start, rows.stop - rows.start, columns.stop - columns.start) for rows, columns in parts],
        np.int64,
    ).reshape(-1, 4)
    scratch, out = np.empty(ROOM_FOR_SCATTER * sigma_px.size), np.empty(len(where))
    arrays = (address(where), len(where), byref(rules), address(scratch), address(out))
    library.excess_scatter(address(pixels), address(sigma_px), sigma_px.shape[1], *arrays)
    return out


def shifts_of_edges(
    library: ctypes.CDLL,
    pixels: FloatArray,
    rising: bool,
    image: NDArray[np.float32],
    scale: float,
    offset: float,
    reach: float,
    along: Sequence[float],
    steps: int,
    most: int,
) -> FloatArray:
    """Return what `detection.checks.validate._shifts` does of `pixels` (R, C, 2), (K,), from about `most` edges."""
    pixels, image = np.ascontiguousarray(pixels, np.float64), np.ascontiguousarray(image, np.float32)
    places = np.array(along, np.float64)
    rows, columns = pixels.shape[:2]
    height, width = image.shape
    sums, out = np.empty((len(places), steps + 1)), np.empty(len(places))
    library.edge_shifts(
        *(address(pixels), rows, columns, 1.0 if rising else -1.0),
        *(address(image), width, height, scale, offset, reach),
        *(address(places), len(places), steps, most, address(sums), address(out)),
    )
    return out
