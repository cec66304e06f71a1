"""Scatter of the corners of a board about smooth rows and columns, relative to their sigmas."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from math import comb

import numpy as np

from rigkit.core.arrays import FloatArray
from rigkit.detection.lattice.spacing import spacing_changes
from rigkit.detection.subpixel.lens_scatter import lens_scatter
from rigkit.kernels import lattice as native
from rigkit.optim.robust_scale import MEDIAN_OF_NORMAL

DIFFERENCES = (5, 6)
MIN_SCATTER_CORNERS, MIN_DIFFERENCES = 12, 16
"""Orders of the differences along rows and columns, and the smallest numbers of corners and differences."""

UNEXPLAINED_SCATTER = 1.25
"""Smallest significant ratio of the scatter to the expected one: fifty corners give smaller ratios by chance."""

STRONG_CURVATURE = 0.25
"""Smallest difference of successive steps, relative to the shorter, that indicates a strong lens: differences of order
6 of rows that turn, or grow, by that much per cell are some hundredths of a pixel in cells of 50 px, the scatter of
good corners."""

MIXED = ((3, 3), (3, 4), (4, 3), (4, 4))
"""Orders of mixed differences, along columns and then along rows. Distortion is similar for neighbouring corners and is
reduced by both differences; scatter is not."""

LOWER_ORDER = 4
"""Order of the differences that exceed those of order 5 and 6, relative to the expected ones, if these are the bend of
a lens and not scatter: of REAL boards with irregular prints 0.7 to 1.3 times, of fisheyes (REAL and RENDERED) 2.1 to 7
times."""

LARGE_SCATTER = 4.0
"""Factor of small boards beyond which `lens_scatter`, which takes 6 ms, decides: most REAL boards of 24
corners scatter by less, and the bend of a fisheye nearby looks like up to 70 sigmas (SIMULATED)."""

THIRD, BEND_DIFFERENCES = 3, 3.0
"""Order of the differences that show the bend of a lens, and largest factors of small boards, over these differences
times the change of successive steps, that the bend may explain; `lens_scatter` then decides. Of SIMULATED boards of
7 x 5 that face an equidistant, equisolid or stereographic fisheye they are 0.9 to 2.0; of scatter alone, whose
differences of all orders are alike, mostly 15 to 30."""

SURFACES, AS_ROUGH, MIN_TERM = (3, 4), 1.5, 1e-6
EVEN_STEPS = 0.12
"""Degrees of the surfaces that are fitted to small boards, largest ratio of the residuals of the first to the second if
they are scatter, and smallest pivot of a term. If successive steps differ by more than EVEN_STEPS, relative to the
shorter, the surfaces do not describe the distortion: on REAL boards it is at most 0.1 with regular lenses and mostly
0.13 to 0.35 with fisheyes."""


def excess_scatter(pixels: FloatArray, sigma_px: FloatArray, parts: Sequence[tuple[slice, slice]]) -> FloatArray:
    """Return the ratio (P,), at least 1, of the scatter of the corners of each part to that expected from their sigmas.

    It is the smallest over the orders DIFFERENCES along rows and columns, with and without removing the best
    perspective: removal helps for strong perspective, differences alone for a fisheye.

    Parameters
    ----------
    pixels : (R, C, 2), NaN where unknown.
    sigma_px : (R, C), NaN likewise.
    parts : the rows and columns of each board.
    """
    return native.excess_scatter(pixels, sigma_px, parts, _rules())


def scatter_factors(pixels: FloatArray, sigma_px: FloatArray, parts: Sequence[tuple[slice, slice]]) -> FloatArray:
    """Return the factors (P,) of the sigmas of each part: `excess_scatter`, for strong lenses also mixed differences,
    of small boards `lens_scatter`.

    Differences along rows do not remove the curvature of strong lenses, nor those of order 5 that of a fisheye near a
    small board; the smallest of all ratios is returned.
    """
    factors = excess_scatter(pixels, sigma_px, parts)
    for k in np.flatnonzero(factors > UNEXPLAINED_SCATTER).tolist():
        part = parts[k]
        strong = any(change.every > STRONG_CURVATURE for change in spacing_changes(pixels[part]))
        small = np.isfinite(native.surface_scatter(pixels[part], sigma_px[part], _rules())[1])
        if small and (strong or factors[k] < BEND_DIFFERENCES * _bend(pixels[part], sigma_px[part])):
            factors[k] = _through_lens(factors[k], pixels[part], sigma_px[part])
        elif strong:
            mixed = (_mixed_roughness(pixels[part], sigma_px[part], *orders) for orders in MIXED)
            factors[k] = max(np.fmin.reduce([factors[k], *mixed]), 1.0)
    return factors


def scatter_factor(pixels: FloatArray, sigma_px: FloatArray) -> float:
    """Return the factor, at least 1, of the sigmas of a board (R, C, 2) of any size: `scatter_factors` where the
    differences of LOWER_ORDER are at most AS_ROUGH as large, and `small_scatter`."""
    every = [(slice(0, pixels.shape[0]), slice(0, pixels.shape[1]))]
    factor = float(scatter_factors(pixels, sigma_px, every)[0])
    if factor > 1.0:
        lower = native.excess_scatter(pixels, sigma_px, every, _rules((LOWER_ORDER, LOWER_ORDER)))[0]
        factor = factor if lower < AS_ROUGH * factor else 1.0
    return factor * small_scatter(pixels, factor * sigma_px)


def small_scatter(pixels: FloatArray, sigma_px: FloatArray) -> float:
    """Return the factor, at least 1, of the sigmas of a board with too few corners (R, C, 2) for the DIFFERENCES.

    Where columns, or rows, are too short for any, twice MIN_DIFFERENCES are asked of the others: a board of 7 x 5 has
    20 along its rows, where the surfaces leave 40.
    The factor follows from the residuals of cubic and quartic surfaces, which are similar if they are scatter. If the
    quartic ones are much smaller, due to a strong lens, the factor is 1. Where both may be the bend of a board that
    faces the lens, which is odd while the quartic terms are even, `lens_scatter` tells.
    """
    cubic, quartic = native.surface_scatter(pixels, sigma_px, _rules())
    if not (cubic < AS_ROUGH * quartic and quartic > UNEXPLAINED_SCATTER):
        return 1.0
    if any(change.every > EVEN_STEPS for change in spacing_changes(pixels)):
        return 1.0
    return _through_lens(quartic, pixels, sigma_px) if quartic > LARGE_SCATTER else quartic


def _through_lens(factor: float, pixels: FloatArray, sigma_px: FloatArray) -> float:
    """Return the smallest of `factor` and the `lens_scatter` of a small board (R, C, 2), at least 1.

    It does not replace a smaller factor: a bent board (REAL, fisheye-chess) is no scatter, but no flat board either.
    """
    return max(min(factor, lens_scatter(pixels, sigma_px)), 1.0)


def _bend(pixels: FloatArray, sigma_px: FloatArray) -> float:
    """Return the differences of order THIRD of a board (R, C, 2), over the expected ones, times the change of its
    steps: what a lens adds to differences of order 5 is a small multiple of it."""
    every = [(slice(0, pixels.shape[0]), slice(0, pixels.shape[1]))]
    third = float(native.excess_scatter(pixels, sigma_px, every, _rules((THIRD, THIRD)))[0])
    changes = (change.every for change in spacing_changes(pixels))
    return third * max((change for change in changes if np.isfinite(change)), default=0.0)


def _mixed_roughness(pixels: FloatArray, sigma_px: FloatArray, down: int, along: int) -> float:
    """Return the median mixed difference of `pixels` (R, C, 2) over the expected one, NaN if there are too few."""
    if pixels.shape[0] <= down or pixels.shape[1] <= along:
        return np.nan
    weights = [np.array([float(comb(order, k)) ** 2 for k in range(order + 1)]) for order in (down, along)]
    windows = np.lib.stride_tricks.sliding_window_view(sigma_px**2, (down + 1, along + 1))
    variance = np.einsum("rcij,i,j->rc", windows, *weights)
    ratio = np.abs(np.diff(np.diff(pixels, down, axis=0), along, axis=1)) / np.sqrt(variance)[..., None]
    seen = ratio[np.isfinite(ratio)]
    return float(np.median(seen)) / MEDIAN_OF_NORMAL if len(seen) >= MIN_DIFFERENCES else np.nan


@functools.cache
def _rules(orders: tuple[int, int] = DIFFERENCES) -> native.ScatterRules:
    return native.ScatterRules(
        unexplained=UNEXPLAINED_SCATTER,
        median_of_normal=MEDIAN_OF_NORMAL,
        min_corners=MIN_SCATTER_CORNERS,
        min_differences=MIN_DIFFERENCES,
        first_order=orders[0],
        last_order=orders[1],
        degrees=SURFACES,
        min_term=MIN_TERM,
    )
