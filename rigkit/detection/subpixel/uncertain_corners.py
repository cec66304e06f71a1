"""Corners with sigmas far larger than those of their board, kept only if they agree with predictions by the others."""

from __future__ import annotations

import numpy as np

from rigkit.core.arrays import BoolArray, FloatArray, known_median

UNCERTAIN_FACTOR, NEARBY_CELLS = 6.0, 2
"""A corner is uncertain if its sigma exceeds this times the median of the board, and of its neighbours up to so many
cells away (in oblique or dark parts many are less certain): usually its window shows something else."""

IN_PLACE_CELLS, IN_PLACE_TIMES = 0.05, 2.0
"""Largest distance of a corner that agrees with its prediction, in cells, or (the larger) relative to the expected
error of the prediction, which is larger at the end of a row."""


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
    if out.any():
        reach = 2 * NEARBY_CELLS + 1
        padded = np.pad(sigma_px, NEARBY_CELLS, constant_values=np.nan)
        around = np.lib.stride_tricks.sliding_window_view(padded, (reach, reach))[out]
        out[out] = sigma_px[out] > UNCERTAIN_FACTOR * np.nanmedian(around, axis=(1, 2))
    return out
