"""How much more the corners of a board scatter about smooth rows and columns than their sigmas say."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from math import comb

import numpy as np

from rigkit.core.arrays import FloatArray
from rigkit.detection.lattice.spacing import spacing_changes
from rigkit.kernels import lattice as native
from rigkit.optim.robust_scale import MEDIAN_OF_NORMAL

DIFFERENCES = (5, 6)
MIN_SCATTER_CORNERS, MIN_DIFFERENCES = 12, 16
"""Orders of the differences along rows and columns, and how many corners and differences there must be."""

UNEXPLAINED = 1.25
"""A scatter about the lattice less than this times the expected one is what chance makes of fifty corners."""

STRONG_CURVATURE = 0.25
"""Neighbouring steps that differ by more than this, relative to the shorter, are a lens's: a difference of order 6 of
what turns, or grows, by that much a cell is some hundredths of a pixel in cells of 50 px, as much as good corners
scatter."""

MIXED = ((3, 3), (3, 4), (4, 3), (4, 4))
"""Orders of the differences along columns and then along rows. What a lens does to a corner it does nearly so to the
corners beside it, so these shrink the bend twice over; scatter they leave as it is."""

SURFACES, AS_ROUGH, MIN_TERM = (3, 4), 1.5, 1e-6
EVEN_STEPS = 0.12
"""Degrees of the surfaces by which small boards are judged, and by how much more the first leaves, at most, if what is
left is scatter; terms that few rows cannot tell are left out. Boards whose neighbouring steps differ by more than the
last number, relative to the shorter, are seen through a lens that bends more than such surfaces: of REAL ones it is 0.1
at most behind regular lenses and mostly 0.13 to 0.35 in fisheyes."""


def excess_scatter(pixels: FloatArray, sigma_px: FloatArray, parts: Sequence[tuple[slice, slice]]) -> FloatArray:
    """Return how much more the corners of each part scatter about smooth rows and columns than their sigmas say, (P,).

    Judged by the DIFFERENCES along rows and columns, with and without the best perspective taken away first: the one is
    blind to strong perspective, the other to a fisheye's bend, and the calmest of them is right. At least 1.

    Parameters
    ----------
    pixels : (R, C, 2), NaN where unknown.
    sigma_px : (R, C), NaN likewise.
    parts : the rows and columns of each board.
    """
    return native.excess_scatter(pixels, sigma_px, parts, _rules())


def scatter_factors(pixels: FloatArray, sigma_px: FloatArray, parts: Sequence[tuple[slice, slice]]) -> FloatArray:
    """Return by how much the sigmas of each part are to be raised, (P,): `excess_scatter` for any lens.

    Strong lenses bend rows by more than the differences along them take away; there those along rows and columns
    together are asked as well, and the calmest is right.
    """
    factors = excess_scatter(pixels, sigma_px, parts)
    for k in np.flatnonzero(factors > UNEXPLAINED).tolist():
        part = parts[k]
        if any(change.every > STRONG_CURVATURE for change in spacing_changes(pixels[part])):
            calmest = np.fmin.reduce([_mixed_roughness(pixels[part], sigma_px[part], *orders) for orders in MIXED])
            factors[k] = max(np.fmin(factors[k], calmest), 1.0)
    return factors


def small_scatter(pixels: FloatArray, sigma_px: FloatArray) -> float:
    """Return by how much the sigmas of a board with too few corners for the DIFFERENCES are to be raised, at least 1.

    A cubic and a quartic surface through all its corners (R, C, 2) leave the same where they leave scatter; what a
    strong lens bends, the second one leaves much less of, and nothing is said.
    """
    cubic, quartic = native.surface_scatter(pixels, sigma_px, _rules())
    if not (cubic < AS_ROUGH * quartic and quartic > UNEXPLAINED):
        return 1.0
    return 1.0 if any(change.every > EVEN_STEPS for change in spacing_changes(pixels)) else quartic


def _mixed_roughness(pixels: FloatArray, sigma_px: FloatArray, down: int, along: int) -> float:
    """Return the typical mixed difference of `pixels` (R, C, 2) over the expected one, NaN where there are few."""
    if pixels.shape[0] <= down or pixels.shape[1] <= along:
        return np.nan
    weights = [np.array([float(comb(order, k)) ** 2 for k in range(order + 1)]) for order in (down, along)]
    windows = np.lib.stride_tricks.sliding_window_view(sigma_px**2, (down + 1, along + 1))
    variance = np.einsum("rcij,i,j->rc", windows, *weights)
    ratio = np.abs(np.diff(np.diff(pixels, down, axis=0), along, axis=1)) / np.sqrt(variance)[..., None]
    seen = ratio[np.isfinite(ratio)]
    return float(np.median(seen)) / MEDIAN_OF_NORMAL if len(seen) >= MIN_DIFFERENCES else np.nan


@functools.cache
def _rules() -> native.ScatterRules:
    return native.ScatterRules(
        unexplained=UNEXPLAINED,
        median_of_normal=MEDIAN_OF_NORMAL,
        min_corners=MIN_SCATTER_CORNERS,
        min_differences=MIN_DIFFERENCES,
        first_order=DIFFERENCES[0],
        last_order=DIFFERENCES[-1],
        degrees=SURFACES,
        min_term=MIN_TERM,
    )
