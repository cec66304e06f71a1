"""What a lattice says of its own corners after a fit: which empty cells are to be tried, which of these have corners,
and which corners lie where the others say that they cannot."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

from rigkit.core.arrays import BoolArray, FloatArray, upper_median
from rigkit.detection.lattice.lattice import Lattice
from rigkit.detection.lattice.local_fit import fit_cells, predicted
from rigkit.detection.subpixel.refined import RefinedLattice
from rigkit.detection.subpixel.uncertain_corners import strays

MIN_NEIGHBOURS = 3
"""An empty cell is tried if so many of its eight neighbours are known."""

MIN_CHECKED = 12
MIN_TESTED = 9
"""A board of fewer corners, or of fewer that so many others predict, is not checked against itself."""

HOLE_MOVE = 0.12
HOLE_CONTRAST = 0.3
HOLE_RESIDUAL = 2.0
HOLE_SIGMA = 3.0
"""What a corner in an empty cell must show: how far from its prediction (cells); contrast, relative residual and sigma
relative to the corners around it."""

DISPLACED_CELLS = 0.06
DISPLACED_SIGMAS = 8.0
"""A corner further than this from where its neighbours say (in cells; and times the board's typical deviation; and
times the standard deviation expected of it) is something else: a finger, a glint, the end of a ruler."""

COVERED_NOISE, COVERED_FACTOR = 0.06, 6.0
COVERED_OFF = 3.5
"""A corner whose noise, relative to its contrast, exceeds this and this times the board's typical one, and that lies
off by this times the typical deviation, is covered in part, by the edge of a ruler or of a hand: its sides are not
alike. On rendered boards under a ruler the factor is 12 and more, on boards with marks in their squares seldom 6; the
noise is 0.065 and more. Glare on single squares of blurred boards, where little other noise is left, makes 0.04."""


def with_holes(lattice: Lattice, inside: BoolArray) -> tuple[Lattice, BoolArray]:
    """Return the lattice with predictions in the empty cells `inside` among known ones, and which cells these are."""
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


def confirmed(item: RefinedLattice, start: Lattice, holes: BoolArray) -> RefinedLattice:
    """Return `item` without those of the `holes` where the fit saw no proper corner."""
    known = item.lattice.known
    settled = known & ~holes
    contrast = item.lattice.contrast
    moved = np.linalg.norm(item.lattice.pixels - start.pixels, axis=2)
    cell = np.full(known.shape, np.nan)
    cell[holes] = fit_cells(start.pixels, holes, degree=1).cell_px()
    with np.errstate(invalid="ignore"):
        good = (moved < HOLE_MOVE * cell) & (contrast > HOLE_CONTRAST * _around(contrast, settled))
        good &= item.residual < HOLE_RESIDUAL * _around(item.residual, settled)
        good &= item.sigma_px < HOLE_SIGMA * _around(item.sigma_px, settled)
    return item.without(holes & ~good)


def _around(values: FloatArray, known: BoolArray) -> FloatArray:
    """Return the mean of `values` (R, C) over the `known` among each cell and its eight neighbours, NaN for none."""
    box = np.ones((3, 3))
    total, count = (
        cv2.filter2D(part, cv2.CV_64F, box, borderType=cv2.BORDER_CONSTANT)
        for part in (np.where(known, values, 0.0), known.astype(np.float64))
    )
    return np.where(count > 0.5, total / np.maximum(count, 0.5), np.nan)


def checked(item: RefinedLattice, parts: Sequence[tuple[slice, slice]]) -> RefinedLattice:
    """Return `item` without corners that are covered in part or lie where their neighbours say they cannot."""
    known = item.lattice.known
    shape = fit_cells(item.lattice.pixels, known, leave_out=True)

    def spread(values: FloatArray) -> FloatArray:
        out = np.full(known.shape, np.nan)
        out[known] = values
        return out

    off = item.lattice.pixels[known] - shape.pixels
    distance = np.hypot(off[:, 0], off[:, 1])
    # A prediction from a few corners on one side is no judge of another.
    judged = np.zeros_like(known)
    judged[known] = (shape.support >= MIN_CHECKED) & (shape.gain < 1.5)
    cells = spread(distance / shape.cell_px())
    excess = spread(distance / (item.sigma_px[known] * np.hypot(1.0, shape.gain)))
    gain = spread(shape.gain)
    relative = item.noise / item.lattice.contrast
    drop = np.zeros_like(known)
    for part in parts:
        here, sure = known[part], judged[part]
        if here.sum() < MIN_CHECKED:
            continue
        drop[part] = strays(item.sigma_px[part], cells[part], gain[part])
        if sure.sum() < MIN_TESTED:
            continue
        typical = upper_median(cells[part][sure])
        typical_residual = upper_median(relative[part][here])
        outlying = (cells[part] > max(DISPLACED_CELLS, DISPLACED_SIGMAS * typical)) & (excess[part] > DISPLACED_SIGMAS)
        covered = relative[part] > max(COVERED_NOISE, COVERED_FACTOR * typical_residual)
        drop[part] |= sure & (outlying | (covered & (cells[part] > COVERED_OFF * typical)))
    return item.without(drop) if drop.any() else item
