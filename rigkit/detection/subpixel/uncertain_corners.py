"""Corners much less sure than others of their board: claimed only where these have them."""

from __future__ import annotations

import numpy as np

from rigkit.core.arrays import BoolArray, FloatArray, known_median

UNCERTAIN_FACTOR, NEARBY_CELLS = 6.0, 2
"""A corner with so many times the sigma that is usual on its board, and so near to it, in cells (where a board is seen
aslant, or in the dark, many are less sure), mostly has something else in its window."""

IN_PLACE_CELLS, IN_PLACE_TIMES = 0.05, 2.0
"""The others have it where it lies within so many cells of where they foretell it, or within so many times the error
that such a prediction usually has: at the end of a row it is further off than within the board."""


def strays(sigma_px: FloatArray, off_cells: FloatArray, gain: FloatArray) -> BoolArray:
    """Return which corners (R, C) of a board are unsure, and not where the others have them.

    Parameters
    ----------
    sigma_px : (R, C), NaN where unknown.
    off_cells : (R, C) how far each lies from where the others foretell it, in sides of its cell; NaN likewise.
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
    """Return which corners of a board are much less sure than others, and those around them; `sigma_px` (R, C), NaN
    where unknown."""
    with np.errstate(invalid="ignore"):
        out = np.asarray(sigma_px > UNCERTAIN_FACTOR * known_median(sigma_px))
    if out.any():
        reach = 2 * NEARBY_CELLS + 1
        padded = np.pad(sigma_px, NEARBY_CELLS, constant_values=np.nan)
        around = np.lib.stride_tricks.sliding_window_view(padded, (reach, reach))[out]
        out[out] = sigma_px[out] > UNCERTAIN_FACTOR * np.nanmedian(around, axis=(1, 2))
    return out
