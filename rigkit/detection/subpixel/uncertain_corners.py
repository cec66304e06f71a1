"""Corners with sigmas far larger than those of their board, kept only if they agree with predictions by the others."""

from __future__ import annotations

import numpy as np

from rigkit.core.arrays import BoolArray, FloatArray, known_median
from rigkit.detection.subpixel.refined import RefinedLattice

UNCERTAIN_FACTOR, NEARBY_CELLS = 6.0, 2
"""A corner is uncertain if its sigma exceeds this times the median of the board, and of its neighbours up to so many
cells away (in oblique or dark parts many are less certain): usually its window shows something else."""

IN_PLACE_CELLS, IN_PLACE_TIMES = 0.05, 2.0
"""Largest distance of a corner that agrees with its prediction, in cells, or (the larger) relative to the expected
error of the prediction, which is larger at the end of a row."""

UNLIKE, OF_ONE_EDGE = 3.0, 4.0
"""Ratio of a corner's residual over contrast to the typical one of the board, and of its neighbours, above which it is
due to an edge in the window (a finger, a sheet), and how much more such residuals move the corner than noise does. On
15 REAL boards with markers, under 90 covers, errors of the 83 corners with three times the typical sigma are 2.1 sigmas
(rms) without this, and 1.4 with it; 8 and 3 exceed 5 sigmas. At the rim of RENDERED fisheye images, where residuals
grow over several corners, sigmas without it are 1 to 3 times the errors."""


def uncertain_outliers(sigma_px: FloatArray, off_cells: FloatArray, gain: FloatArray) -> BoolArray:
    """Return which corners (R, C) of a board are uncertain and contradict their predictions by the others.

    Parameters
    ----------
    sigma_px : (R, C), NaN where unknown.
    off_cells : (R, C) distance of each corner from its prediction, in sides of its cell; NaN likewise.
    gain : (R, C) standard deviation of that prediction for corners of standard deviation 1.
    """
    out = uncertain(sigma_px)
    if not out.any():
        return out
    spread = np.hypot(1.0, gain)
    typical = known_median((off_cells / spread)[np.isfinite(off_cells) & ~out])
    with np.errstate(invalid="ignore"):
        return np.asarray(out & ~(off_cells < np.maximum(IN_PLACE_CELLS, IN_PLACE_TIMES * typical * spread)))


def uncertain(sigma_px: FloatArray) -> BoolArray:
    """Return which corners of a board have far larger `sigma_px` (R, C; NaN where unknown) than the board and than
    their neighbours."""
    with np.errstate(invalid="ignore"):
        out = np.asarray(sigma_px > UNCERTAIN_FACTOR * known_median(sigma_px))
    out[out] = sigma_px[out] > UNCERTAIN_FACTOR * _nearby(sigma_px, out)
    return out


def _nearby(values: FloatArray, where: BoolArray) -> FloatArray:
    """Return the medians of `values` (R, C) up to NEARBY_CELLS around the corners `where`, which are known."""
    if not where.any():
        return np.zeros(0)
    reach = 2 * NEARBY_CELLS + 1
    padded = np.pad(values, NEARBY_CELLS, constant_values=np.nan)
    around = np.lib.stride_tricks.sliding_window_view(padded, (reach, reach))[where].reshape(-1, reach**2)
    # np.nanmedian takes ten times as long. Unknown corners are sorted to the end.
    ordered, count = np.sort(around, axis=1), np.count_nonzero(np.isfinite(around), axis=1)
    each = np.arange(len(around))
    return np.asarray(0.5 * (ordered[each, (count - 1) // 2] + ordered[each, count // 2]))


def sigmas_beside_edges(item: RefinedLattice) -> FloatArray:
    """Return the sigmas (R, C) of the corners of a board, px, that include the shift by edges in their windows that are
    not the board's. Residuals that grow over several corners are those of oblique parts, whose sigmas are right."""
    relative = item.relative_residual
    unlike = relative / (UNLIKE * max(known_median(relative), 1e-9))
    with np.errstate(invalid="ignore"):
        alone = unlike > 1.0
        unlike[alone] = np.minimum(unlike[alone], relative[alone] / (UNLIKE * _nearby(relative, alone)))
        of_edges = np.sqrt(1.0 - np.maximum(unlike, 1.0) ** -2)
    return np.asarray(np.hypot(item.sigma_px, OF_ONE_EDGE * of_edges * item.worst_sigma_px))
