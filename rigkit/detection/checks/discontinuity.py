"""Boards that touch or overlap so nearly in line that one lattice goes on from one to the next.

Where their borders meet there are corners that look like a chessboard's and are none, or lie where the two boards have
them, by hundredths of a square beside where either of them would. So what the edge model fits badly is held against
where the other corners have it; and a lattice whose two sides are each a smooth surface, but not the same one, is cut.
"""

from __future__ import annotations

import functools

import numpy as np

from rigkit.core.arrays import BoolArray, upper_median
from rigkit.detection.checks.validate import stray_row
from rigkit.detection.lattice.local_fit import FLEXIBLE, STIFF, fit_cells
from rigkit.detection.subpixel.refined import RefinedLattice
from rigkit.kernels import lattice as native

SUSPECT_FACTOR = 2.0
"""A corner whose residual, relative to its contrast, exceeds the typical one of the board by this factor is suspect:
chance makes 1.15, the rim of a fisheye at most 3; squares that are not one board's make 2 to 20."""

OUTLIER_FACTOR = 8.0
"""A suspect is dropped that lies further from where the others have it than this times what is typical of the board and
good to expect of the prediction. By the more pliant of the predictions alone that is 7 of 2302 suspects in pictures of
single boards, half of them real, and 220 of 252 on the borders of boards that overlap: the rest lie in line with a row.
"""

MIN_OUTLIER_SIGMAS = 5.0
"""And by more than so many of its own standard deviations: what is uncertain may lie aside."""

IN_PLACE = 3.0
"""A suspect nearer than this, in the same units, to either of the predictions is none."""

MIN_SUSPECT_RESIDUAL = 0.02
"""Residual relative to the contrast below which nothing is suspect: rounding and compression are uneven, too."""

MIN_NEIGHBOURS_FIT = 8
"""Corners behind a prediction that convicts."""

UNUSUAL, MIN_UNUSUAL = 1.3, 3
"""A discontinuity shows: so many corners have residuals beyond this times the typical one."""

WINDOW = 5
"""Columns to either side of a discontinuity that are looked at."""

TWO_SURFACES = 2.5
"""Two quadratic surfaces, one on each side, leave so many times less than one cubic surface through both where they are
two boards. In 248 lattices of single boards, up to the rims of fisheyes, at most 1.8 times."""

JUMP = 0.02
"""Seen from both sides the discontinuity is so wide, in cells: at a crease of the paper the sides meet. It is anywhere
between the columns, and looked for at five places of the way."""

FLOOR_CELLS = 1e-3
"""No printed board is truer than this."""

MIN_BESIDE, MIN_FREE = 5, 6
"""Corners on each side of a discontinuity, and in all beyond what the surfaces take up."""

AS_SMOOTH = 1.3
"""What the two sides leave at the clearest discontinuity and, at most, at a narrower one that is taken for it."""

SURFACE_RIDGE = 1e-9
"""On normal equations of terms of about 1: what too few columns leave open stays 0."""


def may_be_discontinuous(item: RefinedLattice, size_px: tuple[int, int]) -> bool:
    """Return whether `item` may have a discontinuity; a quick look. `size_px` is the (width, height) of the image.

    Corners on a discontinuity fit badly, and where boards are not side by side, corners are missing that the frame
    does not cut off.
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
    """Return `item` without corners that fit badly and are not where the others have them, trimmed.

    What these, and the fit, leave of a row that has strayed into it goes with them. `size_px` is the (width, height) of
    the image.
    """
    return _tidied(_without_displaced(item), size_px)


def _tidied(item: RefinedLattice, size_px: tuple[int, int]) -> RefinedLattice:
    stray = stray_row(item.lattice, size_px)
    while stray is not None:
        item = item.without(stray)
        item = item.cut(*item.lattice.extent)
        stray = stray_row(item.lattice, size_px)
    return item


def _without_displaced(item: RefinedLattice) -> RefinedLattice:
    known = item.lattice.known
    relative = np.zeros(known.shape)
    relative[known] = item.residual[known] / item.lattice.contrast[known]
    typical = upper_median(relative[known])
    suspect = relative > max(SUSPECT_FACTOR * typical, MIN_SUSPECT_RESIDUAL)
    judges = known & ~suspect
    if not suspect.any() or np.count_nonzero(judges) < MIN_NEIGHBOURS_FIT:
        return item
    pixels = item.lattice.without(suspect).pixels
    predicted_fit = fit_cells(pixels, judges, leave_out=True)
    expected = upper_median(np.hypot(*(predicted_fit.pixels - pixels[judges]).T) / predicted_fit.cell_px())
    outlying, in_place = _tested(item, suspect, expected)
    # Under the edge of a shadow whole rows are suspect: those that are in place say where the rows beyond them are.
    while outlying.any() and in_place.any():
        suspect = suspect & ~in_place
        outlying, in_place = _tested(item, suspect, expected)
    if not outlying.any():
        return item
    item = item.without(outlying)
    return item.cut(*item.lattice.extent)


def _tested(item: RefinedLattice, suspect: BoolArray, expected: float) -> tuple[BoolArray, BoolArray]:
    """Return which of the `suspect` corners (R, C) are not where the others have them, and which clearly are.

    The others are mostly as good as `expected`, in cells.
    """
    pixels = item.lattice.without(suspect).pixels
    outlying, in_place = np.zeros((2, *suspect.shape), np.bool_)
    outlying[suspect] = True
    # Both must agree.
    for degree, ridge in (STIFF, FLEXIBLE):
        shape = fit_cells(pixels, suspect, degree=degree, ridge=ridge)
        off = np.hypot(*(shape.pixels - item.lattice.pixels[suspect]).T)
        good = expected * np.hypot(1.0, shape.gain) * shape.cell_px()
        judged = shape.support >= MIN_NEIGHBOURS_FIT
        outlying[suspect] &= judged & (
            off > np.maximum(OUTLIER_FACTOR * good, MIN_OUTLIER_SIGMAS * item.sigma_px[suspect])
        )
        in_place[suspect] |= judged & (off < IN_PLACE * good)
    return outlying, in_place


def split_at_discontinuities(item: RefinedLattice, *, several: bool = False) -> list[RefinedLattice]:
    """Return the boards that `item` is made of, without the corners where they touch.

    several : it is known to be more than one, so the clearest discontinuity is one, however well the two go together.
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
