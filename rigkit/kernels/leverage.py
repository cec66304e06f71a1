"""The call of the kernel in leverage.c: a series of Chebyshev polynomials of symmetric matrices."""

from __future__ import annotations

import numpy as np

from rigkit.core.arrays import FloatArray
from rigkit.kernels import kernels


def chebyshev_series(matrices: FloatArray, vectors: FloatArray, bound: float, series: FloatArray) -> FloatArray:
    """Return sum_k series[k] T_k(2 M / bound - 1) z for symmetric matrices M (N, n, n) and vectors z (N, n).

    `series` has two terms or more; the eigenvalues of M lie between 0 and `bound`.
    """
    matrices, vectors, series = (np.ascontiguousarray(a, np.float64) for a in (matrices, vectors, series))
    out = np.empty_like(vectors)
    memory = np.empty(3 * vectors.shape[1])
    kernels().sum_series(matrices, vectors, *vectors.shape, bound, series, len(series), memory, out)
    return out
