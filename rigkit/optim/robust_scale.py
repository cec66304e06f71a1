"""Factors between medians and standard deviations of Gaussian noise, and the robust standard deviation."""

from __future__ import annotations

import numpy as np

from rigkit.core.arrays import FloatArray

MEDIAN_OF_NORMAL = 0.6745
"""Median of |x| of a Gaussian x of standard deviation 1, to four digits."""
SIGMA_OF_MEDIAN = 1.4826
"""Standard deviation of a Gaussian x with median |x| = 1, to five digits: the inverse of the above."""
MEDIAN_OF_RAYLEIGH = 1.17741
"""Median of |r| of a two-dimensional Gaussian of standard deviation 1 per coordinate: sqrt(2 log 2)."""
MEDIAN_OF_CHI_SQUARE_3 = 2.366
"""Median of |r|^2 of a three-dimensional Gaussian of standard deviation 1 per coordinate."""


def robust_sigma(residuals: FloatArray) -> float:
    """Return the standard deviation of Gaussian residuals (N,) about zero from their median size, which a minority of
    outliers hardly changes; NaN without residuals."""
    return SIGMA_OF_MEDIAN * float(np.median(np.abs(residuals))) if len(residuals) else float("nan")
