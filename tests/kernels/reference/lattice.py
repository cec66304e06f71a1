"""What the detector asks the kernels of lattice.c for, in numpy; arguments as those of `rigkit.kernels.lattice`."""

from __future__ import annotations

import math
from collections.abc import Sequence
from math import comb

import numpy as np
from kernels.reference.links import NO_THRESHOLDS, to_level

from rigkit.core.arrays import FloatArray
from rigkit.detection.lattice.lattice import Lattice
from rigkit.detection.lattice.spacing import SpacingChange
from rigkit.detection.saddles.response import FloatImage, Level, sample
from rigkit.detection.subpixel.scatter import (
    DIFFERENCES,
    MIN_DIFFERENCES,
    MIN_SCATTER_CORNERS,
    MIN_TERM,
    SURFACES,
    UNEXPLAINED_SCATTER,
)
from rigkit.kernels.lattice import ScatterRules
from rigkit.optim.robust_scale import MEDIAN_OF_NORMAL


def uneven_steps(pixels: FloatArray) -> tuple[list[float], list[int], tuple[float, float]]:
    one, two = _changes_along_rows(pixels), _changes_along_rows(pixels.swapaxes(0, 1))
    return one.typical + two.typical, one.seen + two.seen, (one.every, two.every)


def excess_scatter(
    pixels: FloatArray, sigma_px: FloatArray, parts: Sequence[tuple[slice, slice]], rules: ScatterRules
) -> FloatArray:
    assert rules.unexplained == UNEXPLAINED_SCATTER
    return np.array([_excess(pixels[part], sigma_px[part]) for part in parts])


def surface_scatter(pixels: FloatArray, sigma_px: FloatArray, rules: ScatterRules) -> tuple[float, float]:
    assert (tuple(rules.degrees), rules.min_term) == (SURFACES, MIN_TERM)
    counts = _difference_counts(pixels)
    if sum(counts) >= (MIN_DIFFERENCES if min(counts) > 0 else 2 * MIN_DIFFERENCES):
        return np.nan, np.nan
    lower, higher = (_surface_roughness(pixels, sigma_px, degree) for degree in SURFACES)
    return lower, higher


def _difference_counts(pixels: FloatArray) -> list[int]:
    """Return how many differences of the lower order columns and rows of `pixels` (R, C, 2) have."""
    every = (np.diff(pixels, DIFFERENCES[0], axis=axis) for axis in (0, 1))
    return [int(np.count_nonzero(np.isfinite(part))) for part in every]


def _surface_roughness(pixels: FloatArray, sigma_px: FloatArray, degree: int) -> float:
    """Return how far corners lie off a surface of `degree` over what their sigmas say (rms), NaN where it fits any."""
    known = np.isfinite(pixels[..., 0]) & np.isfinite(sigma_px)
    row, column = np.nonzero(known)
    if not len(row):
        return np.nan
    y, x = (2.0 * (place - place.mean()) / max(int(np.ptp(place)), 1) for place in (row, column))
    terms = np.stack([x**i * y**j for i in range(degree + 1) for j in range(degree + 1 - i)], axis=1)
    weight = 1.0 / sigma_px[known]
    surface, size, _ = np.linalg.svd(terms * weight[:, None], full_matrices=False)
    surface = surface[:, size > MIN_TERM * size[0]]
    free = len(row) - surface.shape[1]
    if 2 * free < MIN_DIFFERENCES:
        return np.nan
    places = pixels[known] * weight[:, None]
    return math.sqrt(float(((places - surface @ (surface.T @ places)) ** 2).sum()) / (2.0 * free))


def shifts_of_edges(
    pixels: FloatArray,
    rising: bool,
    image: FloatImage,
    scale: float,
    offset: float,
    reach: Sequence[float],
    along: Sequence[float],
    steps: int,
    most: int,
) -> FloatArray:
    lattice, level = (
        Lattice(pixels, np.full(pixels.shape[:2], np.nan), rising),
        Level(image, NO_THRESHOLDS, scale, offset),
    )
    pixels, signs = to_level(level, lattice.pixels), lattice.signs()
    # The edges that squares start with, and how each square goes on from there: boards seen aslant are flat.
    first, right, below, last = pixels[:-1, :-1], pixels[:-1, 1:], pixels[1:, :-1], pixels[1:, 1:]
    edges = (
        (first, right, 0.5 * (below + last - first - right), signs[:-1, :-1]),
        (first, below, 0.5 * (right + last - first - below), signs[:-1, :-1]),
    )
    start, end, across, sign = (np.concatenate([e[k].reshape(-1, *e[k].shape[2:]) for e in edges]) for k in range(4))
    there = np.flatnonzero(np.isfinite(across[:, 0]))
    there = there[:: max(len(there) // most, 1)]
    start, chord, across = start[there], (end - start)[there], sign[there][:, None] * across[there]
    within = np.array(reach)[:, None, None, None]
    on_chord = start + np.array(along)[:, None, None] * chord
    places = on_chord[:, None] + within * np.linspace(-1.0, 1.0, steps + 1)[:, None, None] * across
    values = sample(level.smooth, places).sum(axis=2, dtype=np.float64)
    # The mean of a step from dark to bright says where it is, however sharp it is.
    dark, bright = values[:, 0], values[:, -1]
    mean = (values.sum(axis=1) - 0.5 * (dark + bright)) / steps
    return np.asarray(2.0 * np.array(reach) * (mean - 0.5 * (dark + bright)) / np.maximum(bright - dark, 1e-9))


def _changes_along_rows(pixels: FloatArray) -> SpacingChange:
    columns = pixels.shape[1]
    if columns < 3:
        return SpacingChange([], [], np.nan)
    step = pixels[:, 1:] - pixels[:, :-1]
    bend = step[:, 1:] - step[:, :-1]
    length = np.hypot(step[..., 0], step[..., 1])
    with np.errstate(divide="ignore", invalid="ignore"):
        relative = np.hypot(bend[..., 0], bend[..., 1]) / np.minimum(length[:, 1:], length[:, :-1])
    here = [column[np.isfinite(column)] for column in relative.T]
    every = np.sort(np.concatenate(here))
    return SpacingChange(
        [float(np.median(column)) if len(column) else np.nan for column in here],
        [len(column) for column in here],
        float(every[len(every) // 2]) if len(every) else np.nan,
    )


def _excess(pixels: FloatArray, sigma_px: FloatArray) -> float:
    if np.count_nonzero(np.isfinite(pixels[..., 0])) < MIN_SCATTER_CORNERS:
        return 1.0
    calmest = np.inf
    for flatten in (False, True):
        values = pixels - _best_plane(pixels) if flatten else pixels
        for order in DIFFERENCES:
            calmest = float(np.fmin(calmest, _roughness(values, sigma_px, order)))
            if calmest <= UNEXPLAINED_SCATTER:
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
