"""The kernels in edges.c, correlation.c and bends.c: the fit of the edge model to corners, what their noise shares, and
how the lines of a lattice bend."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rigkit.core.arrays import BoolArray, FloatArray, GreyImage, IntArray
from rigkit.kernels import kernels
from rigkit.kernels.calls import Struct, image_arguments, structure
from rigkit.kernels.declarations import header

LAG, OUTCOMES = (header().constants[name] for name in ("LAG", "OUTCOMES"))

LAGS = tuple((-up, right) for up in range(LAG + 1) for right in range(-LAG, LAG + 1) if up or right >= 0)
"""How far, in rows and columns, two pixels lie apart whose noise is compared; the opposite ones are the same."""


@structure("edge_rules_t")
class Rules(Struct):
    """The constants of the edge model and its fit."""


@structure("tag_window_t")
class TagWindow(Struct):
    """What windows of the corners of tags go by."""


@structure("factor_rules_t")
class FactorRules(Struct):
    """The constants of `detection.subpixel.correlation`."""


@structure("bend_rules_t")
class BendRules(Struct):
    """The constants of `detection.subpixel.edge_curvature`."""


def fit_corners(
    image: GreyImage,
    pixels: FloatArray,
    sides: FloatArray,
    curvature: FloatArray,
    curvature_sigma: FloatArray,
    gaps: FloatArray,
    tilts: FloatArray,
    reach: FloatArray,
    paper: FloatArray,
    single: FloatArray,
    ends: BoolArray,
    sign: FloatArray,
    blur: FloatArray,
    window_blur: FloatArray,
    contrast: FloatArray,
    rules: Rules,
) -> FloatArray:
    """Return the `OUTCOMES` of N corners, (N, 35). Arguments as `detection.subpixel.edge_fit.fit_edges`."""
    out = np.empty((len(pixels), OUTCOMES))
    kernels().fit_edges(
        *(*image_arguments(image), len(pixels), pixels, sides, curvature, curvature_sigma, gaps, tilts, reach, paper),
        *(single, sign, blur, window_blur, contrast, ends, rules, scratch_of(rules), out),
    )
    return out


def scratch_of(rules: Rules) -> NDArray[np.float32]:
    """Return the room that the windows of a fit take."""
    return np.empty(kernels().edges_scratch(rules), np.float32)


class NoiseOfCorners(NamedTuple):
    """What the fits of N corners leave, and how they went: rows of `fit_edges`, N first in all.

    Attributes
    ----------
    products, pairs : (N, 13) sums of products of what is left in two pixels LAGS apart, and of how many.
    noise, blur, used : (N,) what is left, grey levels; px; pixels of the window.
    pixels, sides : (N, 2) and (N, 2, 2), of the corners and of their cells, px.
    good : (N,) those to rely on.
    owner : (N,) the number of the board of each.
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
    """Return what `detection.subpixel.correlation.sigma_factors` does."""
    out = np.empty(boards)
    kernels().sigma_factors(*corners, len(corners.pixels), boards, rules, out)
    return out


def uneven_factors(corners: NoiseOfCorners, usual: FloatArray, rules: FactorRules) -> FloatArray:
    """Return what `detection.subpixel.correlation.uneven_factors` does."""
    out = np.empty(len(corners.pixels))
    kernels().uneven_factors(*corners, len(corners.pixels), len(usual), usual, rules, out)
    return out


def line_bends(
    pixels: FloatArray, sigma_px: FloatArray, cells: BoolArray, sides_px: FloatArray, rules: BendRules
) -> tuple[FloatArray, FloatArray]:
    """Return what `detection.subpixel.edge_curvature.line_curvature` does."""
    count = len(sides_px)
    if np.count_nonzero(cells) != count:
        raise ValueError(f"line_bends: {count} sides for {np.count_nonzero(cells)} cells")
    out, out_sigma = np.empty((2, count, 2))
    kernels().line_bends(pixels, sigma_px, cells, *cells.shape, count, sides_px, rules, out, out_sigma)
    return out, out_sigma
