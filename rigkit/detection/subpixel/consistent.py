"""Consistency of a lattice after a fit: empty cells to be tried, confirmation of corners in them, outlying corners."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import cv2
import numpy as np

from rigkit.core.arrays import BoolArray, FloatArray, upper_median
from rigkit.detection.lattice.lattice import Lattice
from rigkit.detection.lattice.local_fit import STIFF, Prediction, fit_cells, predicted
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

MAX_GAIN_OF_DROP, CORNER_SIGMAS = 1.5, 3.0
"""Largest gain of a prediction that is judged by the above. At the corners of a board it is 2.7; there a stiffer
prediction, whose gain is 1.4, is compared with the stiff ones of the whole board, and the corner is an outlier if it is
further off, by the above but of CORNER_SIGMAS: light that ends with the board, or heat, moves such corners. In heat
images bad ones are 8.4 to 20 times the median off, and 3.7 to 8.6 sigmas; in 13 sets of REAL boards good ones at most
6.9 times, but up to 11.3 times in images of fisheyes that were distorted further (see BEND_SHARE)."""

BEND_SHARE = 0.75
"""Smallest ratio of the distances from both predictions of such an outlier: a corner that is displaced is as far from
either, and the bend of a strong lens follows the flexible one. In heat images it is 0.9 and more; of 9 good corners of
REAL fisheye images that were outliers otherwise, 0.01 at five (distorted further), 0.6 at one, 0.9 to 1.1 at three."""

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
    # Cells of a pixel are the smallest.
    if not np.fmax.reduce(item.sigma_px, axis=None, initial=0.0) > LOCATED_CELLS:
        return item
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
    flexible = _Contradiction.of(item)
    # Predictions from a few corners on one side are not reliable.
    judged = flexible.reliable & (flexible.gain < MAX_GAIN_OF_DROP)
    ends = _displaced_ends(item, flexible, flexible.reliable & ~judged & (flexible.cells > DISPLACED_CELLS), parts)
    if ends.any():
        # They spoil the predictions of their neighbours.
        return without_inconsistent(item.without(ends), parts)
    relative = item.noise / item.lattice.contrast
    # Corners without neighbours are dropped, too: nothing confirms them.
    around = cv2.boxFilter(known.astype(np.uint8), -1, (3, 3), normalize=False, borderType=cv2.BORDER_CONSTANT)
    alone = known & (around == 1)
    drop = np.zeros_like(known)
    for part in parts:
        here, sure = known[part], judged[part]
        if here.sum() < MIN_CHECKED:
            continue
        cells = flexible.cells[part]
        drop[part] = alone[part] | uncertain_outliers(item.sigma_px[part], cells, flexible.gain[part])
        if sure.sum() < MIN_TESTED:
            continue
        typical = upper_median(cells[sure])
        typical_residual = upper_median(relative[part][here])
        outlying = (cells > max(DISPLACED_CELLS, DISPLACED_SIGMAS * typical)) & (
            flexible.excess[part] > DISPLACED_SIGMAS
        )
        covered = relative[part] > max(COVERED_NOISE, COVERED_FACTOR * typical_residual)
        drop[part] |= sure & (outlying | (covered & (cells > COVERED_OFF * typical)))
    return item.without(drop) if drop.any() else item


def _displaced_ends(
    item: RefinedLattice, flexible: _Contradiction, ends: BoolArray, parts: Sequence[tuple[slice, slice]]
) -> BoolArray:
    """Return which of the `ends` of rows (R, C) are outliers of stiff predictions; mostly there are no `ends`."""
    out = np.zeros_like(ends)
    if not ends.any():
        return out
    stiff = _Contradiction.of(item, STIFF)
    relative = stiff.cells / np.hypot(1.0, stiff.gain)
    for part in parts:
        known = item.lattice.known[part]
        if known.sum() >= MIN_CHECKED:
            out[part] = relative[part] > DISPLACED_SIGMAS * upper_median(relative[part][known])
    alike = flexible.cells > BEND_SHARE * stiff.cells
    return out & ends & alike & stiff.reliable & (stiff.cells > DISPLACED_CELLS) & (stiff.excess > CORNER_SIGMAS)


class _Contradiction(NamedTuple):
    """Distances of the corners (R, C) of a lattice from predictions by the others, NaN where unknown.

    Attributes
    ----------
    cells : distance in sides of the cell.
    excess : distance over its expected standard deviation.
    gain : as of `LocalFit`.
    reliable : whether enough corners predict it.
    """

    cells: FloatArray
    excess: FloatArray
    gain: FloatArray
    reliable: BoolArray

    @classmethod
    def of(cls, item: RefinedLattice, how: Prediction | None = None) -> _Contradiction:
        """Return it for predictions of a kind, by default that of `fit_cells`."""
        known = item.lattice.known
        shape = fit_cells(item.lattice.pixels, known, leave_out=True, **(how._asdict() if how else {}))
        distance = np.hypot(*(item.lattice.pixels[known] - shape.pixels).T)
        columns = (
            distance / shape.cell_px(),
            distance / (item.sigma_px[known] * np.hypot(1.0, shape.gain)),
            shape.gain,
        )
        out = np.full((len(columns), *known.shape), np.nan)
        out[:, known] = columns
        reliable = np.zeros_like(known)
        reliable[known] = shape.support >= MIN_CHECKED
        cells, excess, gain = out
        return cls(cells, excess, gain, reliable)
