"""Calls of the kernels in monotone.c: inverses of increasing functions of a polynomial, and the first root of one."""

from __future__ import annotations

import numpy as np

from rigkit.core.arrays import FloatArray
from rigkit.kernels import kernels
from rigkit.kernels.calls import make_struct


def inverses(
    polynomial: FloatArray,
    parts: tuple[FloatArray, FloatArray, FloatArray],
    target: FloatArray,
    table: FloatArray,
    values: tuple[float, float],
    limits: tuple[float, float],
) -> FloatArray:
    """Return the roots x (N,) between the `limits` of linear x + factor P(x) - offset, increasing in x, by Newton's
    method safeguarded by a bracket.

    Parameters
    ----------
    polynomial : coefficients of P, of the power zero first.
    parts : linear, factor and offset, (N,) each.
    target : (N,) arguments of the `table` (cells + 1,) of initial x, which is uniform between the two `values`.
    """
    linear, factor, offset = parts
    functions = make_struct(
        "increasing_t",
        polynomial=polynomial,
        linear=linear,
        factor=factor,
        offset=offset,
        target=target,
        table=table,
        cells=len(table) - 1,
        first=values[0],
        last=values[1],
        low=limits[0],
        high=limits[1],
    )
    return np.asarray(kernels().invert_increasing(functions))


def smallest_root(polynomials: FloatArray, limit: float) -> float:
    """Return the smallest root in (0, `limit`] of polynomials (M, K), of the power zero first, that do not vanish at
    zero; `limit` without a root, NaN if one overflows."""
    return float(kernels().smallest_root(polynomials, limit))
