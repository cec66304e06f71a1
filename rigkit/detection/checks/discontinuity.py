"""Boards that touch or overlap almost in line, so that one lattice extends over both.

Corners at their common border are wrong, or off by hundredths of a square. Corners with large residuals of the edge
model are therefore compared with predictions from the other corners. A lattice whose two sides are smooth surfaces, but
not one and the same, is split.
"""

from __future__ import annotations

import functools

import numpy as np

from rigkit.core.arrays import BoolArray, upper_median
from rigkit.detection.checks.validate import stray_row
from rigkit.detection.lattice.local_fit import FLEXIBLE, MIN_PREDICTORS, STIFF, fit_cells
from rigkit.detection.subpixel.refined import RefinedLattice
from rigkit.kernels import lattice as native

SUSPECT_FACTOR = 2.0
"""A corner is suspect if its residual over its contrast exceeds the median of the board by this factor. By chance it is
1.15, at the rim of a fisheye at most 3; at borders of two boards it is 2 to 20."""

OUTLIER_SIGMAS = 5.0
"""A suspect is dropped if it is further from its predictions than this times their errors and its own standard
deviation, and predicts others if it is closer than this times the error of one: the sigma of a suspect is too large for
that. Of 10582 corners of single boards in 212 REAL images this drops none with 4 and more, and 5 with 2.5."""

UNUSUAL, MIN_UNUSUAL = 1.3, 3
"""There may be a discontinuity if at least MIN_UNUSUAL corners have residuals above UNUSUAL times the median: a sheet
bent like a wave of a few squares has no such corners, but is no smooth surface either, and would be split."""

WINDOW = 5
"""Columns on each side of a discontinuity that are used."""

TWO_SURFACES = 2.5
"""Smallest ratio, at a discontinuity, of the residuals of one cubic surface to those of two quadratic surfaces, one on
each side. In 248 lattices of single boards, up to the rims of fisheyes, it is at most 1.8."""

JUMP = 0.02
"""Smallest jump at a discontinuity, in cells: at a crease of the paper the two sides meet. It is evaluated at five
positions between two columns."""

FLOOR_CELLS = 1e-3
"""Lower bound of the scatter, in cells, due to imperfect prints."""

MIN_BESIDE, MIN_FREE = 5, 6
"""Smallest number of corners on each side of a discontinuity, and smallest redundancy of the surfaces."""

AS_SMOOTH = 1.3
"""Largest ratio of the residuals at a narrower discontinuity to those at the clearest one, to be preferred to it."""

SURFACE_RIDGE = 1e-9
"""Ridge of the normal equations, whose terms are about 1: terms that few columns do not determine remain 0."""


def may_be_discontinuous(item: RefinedLattice, size_px: tuple[int, int]) -> bool:
    """Return quickly whether `item` may have a discontinuity; `size_px` is the (width, height) of the image.

    Corners on a discontinuity have large residuals; if boards are not exactly side by side, corners within the image
    are missing.
    """
    known = item.lattice.known
    relative = np.sort(item.residual[known] / item.lattice.contrast[known])
    if len(relative) > MIN_UNUSUAL and float(relative[-MIN_UNUSUAL]) > UNUSUAL * float(relative[len(relative) // 2]):
        return True
    if known.all():
        return False
    missing = fit_cells(item.lattice.pixels, ~known, degree=1).pixels
    inside = ((missing > 0.0) & (missing < np.array(size_px) - 1.0)).all(axis=1)
    return int(np.count_nonzero(inside)) >= MIN_UNUSUAL


def without_outliers(item: RefinedLattice, size_px: tuple[int, int]) -> RefinedLattice:
    """Return `item` without corners that have large residuals and contradict the others, and without stray rows.

    The result is trimmed. `size_px` is the (width, height) of the image.
    """
    item = _without_displaced(item)
    while (stray := stray_row(item.lattice, size_px)) is not None:
        item = item.without(stray).trimmed()
    return item


def _without_displaced(item: RefinedLattice) -> RefinedLattice:
    known = item.lattice.known
    relative = np.zeros(known.shape)
    relative[known] = item.residual[known] / item.lattice.contrast[known]
    typical = upper_median(relative[known])
    suspect = relative > SUSPECT_FACTOR * typical
    predictors = known & ~suspect
    if not suspect.any() or np.count_nonzero(predictors) < MIN_PREDICTORS:
        return item
    pixels = item.lattice.without(suspect).pixels
    predicted_fit = fit_cells(pixels, predictors, leave_out=True)
    expected = upper_median(np.hypot(*(predicted_fit.pixels - pixels[predictors]).T) / predicted_fit.cell_px())
    outlying, in_place = _tested(item, suspect, expected)
    # At the edge of a shadow whole rows are suspect: inliers among them serve to predict the rows beyond.
    while outlying.any() and in_place.any():
        suspect = suspect & ~in_place
        outlying, in_place = _tested(item, suspect, expected)
    if not outlying.any():
        return item
    return item.without(outlying).trimmed()


def _tested(item: RefinedLattice, suspect: BoolArray, expected: float) -> tuple[BoolArray, BoolArray]:
    """Return which of the `suspect` corners (R, C) contradict their predictions, and which agree with one.

    `expected` is the typical error of the other corners, in cells.
    """
    pixels = item.lattice.without(suspect).pixels
    outlying, in_place = np.zeros((2, *suspect.shape), np.bool_)
    outlying[suspect] = True
    # Outliers of both predictions.
    for how in (STIFF, FLEXIBLE):
        shape = fit_cells(pixels, suspect, **how._asdict())
        off = np.hypot(*(shape.pixels - item.lattice.pixels[suspect]).T)
        good = expected * np.hypot(1.0, shape.gain) * shape.cell_px()
        tested = shape.support >= MIN_PREDICTORS
        outlying[suspect] &= tested & (off > OUTLIER_SIGMAS * np.maximum(good, item.sigma_px[suspect]))
        in_place[suspect] |= tested & (off < OUTLIER_SIGMAS * good)
    return outlying, in_place


def split_at_discontinuities(item: RefinedLattice, *, several: bool = False) -> list[RefinedLattice]:
    """Return the boards in `item`, without the corners where they touch.

    several : it is known to be more than one board: split at the clearest discontinuity in any case.
    """
    if item.lattice.count < 2 * MIN_BESIDE + MIN_FREE:
        return [item]
    across, down = native.clearest_splits(item.lattice.pixels, item.sigma_px, several, _rules())
    every, (ratio, start, end) = slice(0, None), max(across, down, key=lambda split: split[0])
    if ratio == 0.0:
        return [item]
    sides = (slice(0, start), slice(end, None))
    cuts = [(every, side) if across[0] == ratio else (side, every) for side in sides]
    return [part for cut in cuts for part in split_at_discontinuities(item.cut(*cut))]


@functools.cache
def _rules() -> native.SplitRules:
    return native.SplitRules.of(
        window=WINDOW,
        min_beside=MIN_BESIDE,
        min_free=MIN_FREE,
        two_surfaces=TWO_SURFACES,
        jump=JUMP,
        floor_cells=FLOOR_CELLS,
        as_smooth=AS_SMOOTH,
        ridge=SURFACE_RIDGE,
    )
