"""The kernels in edges.c: the fit of the edge model to corners, and how the lines of a lattice bend."""

from __future__ import annotations

import ctypes
import functools
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from rigkit.core.arrays import BoolArray, FloatArray
from rigkit.kernels import address, kernels

__all__ = ["LAGS", "OUTCOMES", "BendRules", "Rules", "fit_corners", "line_bends"]

LAGS = tuple((-up, right) for up in range(3) for right in range(-2, 3) if up or right >= 0)
"""How far, in rows and columns, two pixels lie apart whose noise is compared; the opposite ones are the same."""

OUTCOMES = 9 + 2 * len(LAGS)
"""Numbers that come out of a corner: u, v, sigma, s, 2 b, RMS residual, RMS noise, whether it is valid, its pixels, for
each of the `LAGS` the sum of products of the noise, and of how many."""


class Rules(ctypes.Structure):
    """The constants of the edge model and its fit, in the order of `rules_t` in edges.c."""

    _fields_: ClassVar = [
        *(
            (name, ctypes.c_double)
            for name in (
                "reach",
                "end_sigmas",
                "least_reach",
                "near_sigmas",
                "near_px",
                "tail_sigmas",
                "pixel_kurtosis",
                "sharp_blur",
                "least_blur",
                "most_blur",
                "angle_sigma",
                "log_blur_sigma",
                "light_sigma",
                "most_move_px",
                "most_turn",
                "most_blur_change",
                "most_light_change",
                "least_variance",
                "ridge",
                "converged_px",
                "blur_lag",
                "valid_move_px",
                "valid_move_cells",
                "most_mirrored",
                "radius_px",
            )
        ),
        *((name, ctypes.c_int64) for name in ("iterations", "mirrored", "fewest_mirrored")),
    ]


class BendRules(ctypes.Structure):
    """The constants of `detection.subpixel.edge_curvature`, in the order of `bend_rules_t` in edges.c."""

    _fields_: ClassVar = [
        ("decay", ctypes.c_double),
        ("least_sigma", ctypes.c_double),
        ("free", ctypes.c_double),
        ("bent", ctypes.c_double),
        ("reach", ctypes.c_int64),
    ]


@functools.cache
def _library() -> ctypes.CDLL | None:
    library = kernels("edges")
    if library is not None:
        count, array = ctypes.c_int64, ctypes.c_void_p
        library.edges_scratch.restype = count
        library.edges_scratch.argtypes = [array]
        library.fit_edges.restype = None
        library.fit_edges.argtypes = [array, count, count, count, count, *[array] * 12]
        library.line_bends.restype = None
        library.line_bends.argtypes = [array, array, array, count, count, array, array, array, array]
    return library


def fit_corners(
    image: NDArray[np.uint8] | NDArray[np.float32],
    pixels: FloatArray,
    sides: FloatArray,
    curvature: FloatArray,
    curvature_sigma: FloatArray,
    gaps: FloatArray,
    ends: BoolArray,
    sign: FloatArray,
    blur: FloatArray,
    contrast: FloatArray,
    rules: Rules,
) -> FloatArray | None:
    """Return the `OUTCOMES` of N corners, (N, 35), or None without the compiled kernel. Arguments as `fit_edges`."""
    library = _library()
    if library is None:
        return None
    grey = np.ascontiguousarray(image)
    parts = (pixels, sides, curvature, curvature_sigma, gaps, sign, blur, contrast)
    known = [np.ascontiguousarray(part, np.float64) for part in parts]
    edges = np.ascontiguousarray(ends, np.bool_)
    out = np.empty((len(pixels), OUTCOMES))
    scratch = np.zeros(library.edges_scratch(ctypes.addressof(rules)), np.float32)
    height, width = grey.shape
    library.fit_edges(
        address(grey),
        grey.dtype == np.uint8,
        width,
        height,
        len(pixels),
        *(address(part) for part in known),
        address(edges),
        ctypes.addressof(rules),
        address(scratch),
        address(out),
    )
    return out


def line_bends(
    pixels: FloatArray, sigma_px: FloatArray, cells: BoolArray, sides_px: FloatArray, rules: BendRules
) -> tuple[FloatArray, FloatArray] | None:
    """Return what `detection.subpixel.edge_curvature.line_curvature` does, or None without the compiled kernel."""
    library = _library()
    if library is None:
        return None
    places, sigmas = np.ascontiguousarray(pixels, np.float64), np.ascontiguousarray(sigma_px, np.float64)
    wanted, sides = np.ascontiguousarray(cells, np.bool_), np.ascontiguousarray(sides_px, np.float64)
    rows, columns = wanted.shape
    out, out_sigma = np.empty((2, len(sides), 2))
    library.line_bends(
        address(places),
        address(sigmas),
        address(wanted),
        rows,
        columns,
        address(sides),
        ctypes.addressof(rules),
        address(out),
        address(out_sigma),
    )
    return out, out_sigma
