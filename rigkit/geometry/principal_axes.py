"""Decomposition of a covariance into independent steps of one standard deviation each."""

from __future__ import annotations

import numpy as np

from rigkit.core.arrays import FloatArray

NEGLIGIBLE = 1e-12
"""Relative variance (of parameters scaled to one sigma) up to which a principal axis is left out."""


def principal_axes(covariance: FloatArray) -> FloatArray:
    """Return rows (K, P) whose outer products sum up to `covariance`: independent steps of one sigma each."""
    sigma = np.sqrt(np.diag(covariance))
    safe = np.where(sigma > 0.0, sigma, 1.0)
    values, vectors = np.linalg.eigh(covariance / np.outer(safe, safe))
    kept = values > NEGLIGIBLE * values[-1]
    return np.asarray((vectors[:, kept] * np.sqrt(values[kept])).T * sigma)
