"""A covariance as independent moves of one standard deviation each."""

from __future__ import annotations

import numpy as np

from rigkit.core.arrays import FloatArray

NEGLIGIBLE = 1e-12
"""Principal axes with less than this part of the largest variance (parameters scaled to one sigma) are left out."""


def principal_axes(covariance: FloatArray) -> FloatArray:
    """Return rows (K, P) with sum of outer products equal to `covariance`: independent moves of one sigma each."""
    sigma = np.sqrt(np.diag(covariance))
    safe = np.where(sigma > 0.0, sigma, 1.0)
    values, vectors = np.linalg.eigh(covariance / np.outer(safe, safe))
    kept = values > NEGLIGIBLE * values[-1]
    return np.asarray((vectors[:, kept] * np.sqrt(values[kept])).T * sigma)
