"""The kernels in edges.c, correlation.c and curvatures.c: the fit of the edge model to corners, the correlation of
their noise, and the curvatures of the lines of a lattice."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from rigkit.core.arrays import BoolArray, FloatArray, GreyImage, IntArray
from rigkit.kernels import kernels
from rigkit.kernels.calls import Struct, structure
from rigkit.kernels.declarations import header

LAG = header().constants["LAG"]

LAGS = tuple((-up, right) for up in range(LAG + 1) for right in range(-LAG, LAG + 1) if up or right >= 0)
"""Lags (rows, columns) of the correlation of noise; opposite lags are equivalent."""


@structure("edge_rules_t")
class Rules(Struct):
    """The constants of the edge model and its fit."""


@structure("tag_window_t")
class TagWindow(Struct):
    """Parameters of the windows of the corners of tags."""


@structure("factor_rules_t")
class FactorRules(Struct):
    """The constants of `detection.subpixel.correlation`."""


@structure("curvature_rules_t")
class CurvatureRules(Struct):
    """The constants of `detection.subpixel.edge_curvature`."""


class CornerWindows(NamedTuple):
    """Windows of N corners and the expected state of their edge model, in the order of the kernel `fit_edges`: see
    `detection.subpixel.edge_model.Geometry` and `detection.subpixel.edge_fit.fit_edges`."""

    pixels: FloatArray
    sides: FloatArray
    curvature: FloatArray
    curvature_sigma: FloatArray
    gaps: FloatArray
    tilts: FloatArray
    reach: FloatArray
    paper: FloatArray
    single: FloatArray
    sign: FloatArray
    blur: FloatArray
    window_blur: FloatArray
    contrast: FloatArray
    ends: BoolArray


def fit_corners(image: GreyImage, windows: CornerWindows, rules: Rules) -> FloatArray:
    """Return the OUTCOMES (api.h) of N corners, (N, 35)."""
    return np.asarray(kernels().fit_edges(image, *windows, rules))


class NoiseOfCorners(NamedTuple):
    """Residuals and other results of the fits of N corners, from `fit_edges`.

    Attributes
    ----------
    products, pairs : (N, 13) sums of products of residuals of pixels at LAGS, and their numbers.
    noise, blur, used : (N,) rms noise, grey levels; s, px; number of pixels of the window.
    pixels, sides : (N, 2) and (N, 2, 2), of the corners and of their cells, px.
    good : (N,) corners to be used.
    owner : (N,) index of the board of each.
    """

    products: FloatArray
    pairs: FloatArray
    noise: FloatArray
    pixels: FloatArray
    sides: FloatArray
    blur: FloatArray
    used: FloatArray
    good: BoolArray
    owner: IntArray


def sigma_factors(corners: NoiseOfCorners, boards: int, rules: FactorRules) -> FloatArray:
    """See `detection.subpixel.correlation.board_factors`."""
    return np.asarray(kernels().sigma_factors(*corners, boards, rules))


def uneven_factors(corners: NoiseOfCorners, typical: FloatArray, rules: FactorRules) -> FloatArray:
    """Return the additional factor (N,) of each corner's sigma: 1, and more for corners whose windows show more than
    noise.

    A shadow edge, glare or a finger in the window causes residuals that are correlated over many pixels; the part of
    them that looks like a shift of the corner is not in the residuals. `typical` (P,) are the boards' `sigma_factors`.
    """
    return np.asarray(kernels().uneven_factors(*corners, typical, rules))


def line_curvatures(
    pixels: FloatArray, sigma_px: FloatArray, cells: BoolArray, sides_px: FloatArray, rules: CurvatureRules
) -> tuple[FloatArray, FloatArray]:
    """See `detection.subpixel.edge_curvature.line_curvature`."""
    count = len(sides_px)
    if np.count_nonzero(cells) != count:
        raise ValueError(f"line_curvatures: {count} sides for {np.count_nonzero(cells)} cells")
    curvatures: tuple[FloatArray, FloatArray] = kernels().line_curvatures(pixels, sigma_px, cells, sides_px, rules)
    return curvatures
