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

__all__ = ["UNEXPLAINED", "excess_scatter", "scatter_factors"]

DIFFERENCES = (5, 6)
MIN_SCATTER_CORNERS, MIN_DIFFERENCES = 12, 16
"""Orders of the differences along rows and columns, and how many corners and differences there must be."""

UNEXPLAINED = 1.25
"""A scatter about the lattice less than this times the expected one is what chance makes of fifty corners."""

STRONG_BEND = 0.25
"""Neighbouring steps that differ by more than this, relative to the shorter, are a lens's: a difference of order 6 of
what turns, or grows, by that much a cell is some hundredths of a pixel in cells of 50 px, as much as good corners
scatter."""

MIXED = ((3, 3), (3, 4), (4, 3), (4, 4))
"""Orders of the differences along columns and then along rows. What a lens does to a corner it does nearly so to the
corners beside it, so these shrink the bend twice over; scatter they leave as it is."""


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
    library = native.loaded()
    if library is not None:
        return native.excess_scatter(pixels, sigma_px, parts, _rules())
    return np.array([_excess(pixels[part], sigma_px[part]) for part in parts])


def scatter_factors(pixels: FloatArray, sigma_px: FloatArray, parts: Sequence[tuple[slice, slice]]) -> FloatArray:
    """Return by how much the sigmas of each part are to be raised, (P,): `excess_scatter` for any lens.

    Strong lenses bend rows by more than the differences along them take away; there those along rows and columns
    together are asked as well, and the calmest is right.
    """
    factors = excess_scatter(pixels, sigma_px, parts)
    for k in np.flatnonzero(factors > UNEXPLAINED).tolist():
        part = parts[k]
        if any(change.every > STRONG_BEND for change in spacing_changes(pixels[part])):
            calmest = np.fmin.reduce([_mixed_roughness(pixels[part], sigma_px[part], *orders) for orders in MIXED])
            factors[k] = max(np.fmin(factors[k], calmest), 1.0)
    return factors


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
        fewest_corners=MIN_SCATTER_CORNERS,
        fewest_differences=MIN_DIFFERENCES,
        first_order=DIFFERENCES[0],
        last_order=DIFFERENCES[-1],
    )


def _excess(pixels: FloatArray, sigma_px: FloatArray) -> float:
    if np.count_nonzero(np.isfinite(pixels[..., 0])) < MIN_SCATTER_CORNERS:
        return 1.0
    calmest = np.inf
    for flatten in (False, True):
        values = pixels - _best_plane(pixels) if flatten else pixels
        for order in DIFFERENCES:
            calmest = float(np.fmin(calmest, _roughness(values, sigma_px, order)))
            if calmest <= UNEXPLAINED:
                return 1.0
    return calmest if np.isfinite(calmest) else 1.0


def _best_plane(pixels: FloatArray) -> FloatArray:
    """Return (R, C, 2) where the corners of the best flat board through a pinhole would be; NaN where unknown.

    Best in the linear sense, all coordinates between -1 and 1: what this misses is smooth, and no difference sees it.
    """
    row, column = np.nonzero(np.isfinite(pixels[..., 0]))
    known = pixels[row, column]
    mean = known.mean(axis=0)
    unit = np.abs(known - mean).sum() / len(known)
    p = (known - mean) / unit
    size = np.array(pixels.shape[1::-1])
    x, y = (2.0 * np.stack([column, row], axis=-1) / size - 1.0).T
    one, none = np.ones(len(x)), np.zeros(len(x))
    design = np.concatenate(
        [
            np.stack([x, y, one, none, none, none, -p[:, 0] * x, -p[:, 0] * y], axis=-1),
            np.stack([none, none, none, x, y, one, -p[:, 1] * x, -p[:, 1] * y], axis=-1),
        ]
    )
    h, _, rank, _ = np.linalg.lstsq(design, p.T.ravel(), rcond=None)
    flat = np.full(pixels.shape, np.nan)
    if rank == len(h):
        depth = h[6] * x + h[7] * y + 1.0
        plane = np.stack([h[0] * x + h[1] * y + h[2], h[3] * x + h[4] * y + h[5]], axis=-1)
        flat[row, column] = plane / depth[:, None] * unit + mean
    return flat


def _roughness(values: FloatArray, sigma_px: FloatArray, order: int) -> float:
    """Return the typical difference of `order` of `values` (R, C, 2) over the expected one, NaN where there are few."""
    factors = [float(comb(order, k)) ** 2 for k in range(order + 1)]
    found: list[FloatArray] = []
    for along in (0, 1):
        moved, square = values.swapaxes(0, along), sigma_px.swapaxes(0, along) ** 2
        count = len(square) - order
        if count <= 0:
            continue
        variance = sum(factor * square[k : k + count] for k, factor in enumerate(factors))
        ratio = np.abs(np.diff(moved, order, axis=0)) / np.sqrt(variance)[..., None]
        found.append(ratio[np.isfinite(ratio)])
    every = np.concatenate(found) if found else np.zeros(0)
    return float(np.median(every)) / MEDIAN_OF_NORMAL if len(every) >= MIN_DIFFERENCES else np.nan
