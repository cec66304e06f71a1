"""Consistency of a lattice after a fit: empty cells to be tried, confirmation of corners in them, outlying corners."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

from rigkit.core.arrays import BoolArray, FloatArray, upper_median
from rigkit.detection.lattice.lattice import Lattice
from rigkit.detection.lattice.local_fit import fit_cells, predicted
from rigkit.detection.subpixel.refined import RefinedLattice
from rigkit.detection.subpixel.uncertain_corners import uncertain_outliers

MIN_NEIGHBOURS = 3
"""Smallest number of known corners among the eight neighbours of an empty cell that is tried."""

MIN_CHECKED = 12
MIN_TESTED = 9
"""Smallest number of corners of a board, and of a prediction, and smallest number of predicted corners, for the
test."""

MOVED_CELLS = 0.12
"""Largest distance of a corner that is added from its prediction, in sides of its cell."""

HOLE_RESIDUAL, HOLE_SIGMA = 2.0, 3.0
"""Largest residual and sigma of a corner in an empty cell, relative to the corners around it. Sigma is inverse to the
contrast, which needs no limit of its own."""

DISPLACED_CELLS = 0.06
DISPLACED_SIGMAS = 8.0
"""A corner is an outlier if its distance from its prediction exceeds DISPLACED_CELLS, DISPLACED_SIGMAS times the median
of the board, and DISPLACED_SIGMAS times its expected standard deviation: a finger, a glint, the end of a ruler."""

COVERED_NOISE, COVERED_FACTOR = 0.06, 6.0
COVERED_OFF = 3.5
"""A corner is partly covered if its noise over contrast exceeds COVERED_NOISE and COVERED_FACTOR times the median of
the board, and its distance from its prediction COVERED_OFF times the median: an edge of a ruler or a hand makes its
sides unequal. On RENDERED boards under a ruler the factor is 12 and more and the noise 0.065 and more; on boards with
markers the factor is seldom 6; glare on single squares of blurred boards with little noise gives 0.04."""


LOCATED_CELLS = 0.25
"""Largest standard deviation of a corner, in sides of its cell: more would not tell it from the middle of an edge. In
REAL images of boards it is at most 0.13, beside a seam of two boards; without contrast it is up to thousands."""


def with_predicted_holes(lattice: Lattice, inside: BoolArray) -> tuple[Lattice, BoolArray]:
    """Return the lattice with predictions in those empty cells `inside` that have known neighbours, and these cells."""
    known = lattice.known
    holes: BoolArray = inside & ~known
    if holes.any():
        around = cv2.boxFilter(known.astype(np.uint8), -1, (3, 3), normalize=False, borderType=cv2.BORDER_CONSTANT)
        holes &= around >= MIN_NEIGHBOURS
    if not holes.any():
        return lattice, holes
    shape = predicted(lattice.pixels, holes)
    pixels = lattice.pixels.copy()
    pixels[holes] = shape.pixels
    return Lattice(pixels, lattice.contrast, lattice.rising), holes


def without_unconfirmed_holes(item: RefinedLattice, start: Lattice, holes: BoolArray) -> RefinedLattice:
    """Return `item` without those of the `holes` where the fit does not confirm a corner."""
    known = item.lattice.known
    settled = known & ~holes
    moved = np.linalg.norm(item.lattice.pixels - start.pixels, axis=2)
    cell = np.full(known.shape, np.nan)
    cell[holes] = fit_cells(start.pixels, holes, degree=1).cell_px()
    with np.errstate(invalid="ignore"):
        good = (moved < MOVED_CELLS * cell) & (
            item.residual < HOLE_RESIDUAL * _mean_of_neighbours(item.residual, settled)
        )
        good &= item.sigma_px < HOLE_SIGMA * _mean_of_neighbours(item.sigma_px, settled)
    return item.without(holes & ~good)


def without_uncertain(item: RefinedLattice) -> RefinedLattice:
    """Return `item` without corners whose standard deviation exceeds LOCATED_CELLS."""
    known = item.lattice.known
    vague = np.zeros_like(known)
    cell_px = fit_cells(item.lattice.pixels, known, degree=1).cell_px()
    vague[known] = item.sigma_px[known] > LOCATED_CELLS * cell_px
    return item.without(vague) if vague.any() else item


def _mean_of_neighbours(values: FloatArray, known: BoolArray) -> FloatArray:
    """Return the mean of `values` (R, C) over the `known` among each cell and its eight neighbours, NaN for none."""
    box = np.ones((3, 3))
    total, count = (
        cv2.filter2D(part, cv2.CV_64F, box, borderType=cv2.BORDER_CONSTANT)
        for part in (np.where(known, values, 0.0), known.astype(np.float64))
    )
    return np.where(count > 0.5, total / np.maximum(count, 0.5), np.nan)


def without_inconsistent(item: RefinedLattice, parts: Sequence[tuple[slice, slice]]) -> RefinedLattice:
    """Return `item` without corners of its `parts` that are partly covered or contradict their neighbours."""
    known = item.lattice.known
    shape = fit_cells(item.lattice.pixels, known, leave_out=True)

    def spread(values: FloatArray) -> FloatArray:
        out = np.full(known.shape, np.nan)
        out[known] = values
        return out

    off = item.lattice.pixels[known] - shape.pixels
    distance = np.hypot(off[:, 0], off[:, 1])
    # Predictions from a few corners on one side are not reliable.
    judged = np.zeros_like(known)
    judged[known] = (shape.support >= MIN_CHECKED) & (shape.gain < 1.5)
    cells = spread(distance / shape.cell_px())
    excess = spread(distance / (item.sigma_px[known] * np.hypot(1.0, shape.gain)))
    gain = spread(shape.gain)
    relative = item.noise / item.lattice.contrast
    # Corners without neighbours are dropped, too: nothing confirms them.
    around = cv2.boxFilter(known.astype(np.uint8), -1, (3, 3), normalize=False, borderType=cv2.BORDER_CONSTANT)
    alone = known & (around == 1)
    drop = np.zeros_like(known)
    for part in parts:
        here, sure = known[part], judged[part]
        if here.sum() < MIN_CHECKED:
            continue
        drop[part] = alone[part] | uncertain_outliers(item.sigma_px[part], cells[part], gain[part])
        if sure.sum() < MIN_TESTED:
            continue
        typical = upper_median(cells[part][sure])
        typical_residual = upper_median(relative[part][here])
        outlying = (cells[part] > max(DISPLACED_CELLS, DISPLACED_SIGMAS * typical)) & (excess[part] > DISPLACED_SIGMAS)
        covered = relative[part] > max(COVERED_NOISE, COVERED_FACTOR * typical_residual)
        drop[part] |= sure & (outlying | (covered & (cells[part] > COVERED_OFF * typical)))
    return item.without(drop) if drop.any() else item
