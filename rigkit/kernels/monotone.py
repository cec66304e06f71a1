"""Calls of the kernels in monotone.c: inverting increasing functions that a polynomial makes, and its first root."""

from __future__ import annotations

import numpy as np

from rigkit.core.arrays import FloatArray
from rigkit.kernels import kernels
from rigkit.kernels.calls import Struct, structure


@structure("increasing_t")
class _Increasing(Struct):
    """The functions, a table from which each inverse starts, and the range of the inverses."""


def inverses(
    polynomial: FloatArray,
    parts: tuple[FloatArray, FloatArray, FloatArray],
    target: FloatArray,
    table: FloatArray,
    values: tuple[float, float],
    limits: tuple[float, float],
) -> FloatArray:
    """Return the x (N,) between the `limits` at which linear x + factor P(x) - offset, increasing in x, vanishes: by
    Newton's method kept inside a bracket.

    Parameters
    ----------
    polynomial : coefficients of P, of the power zero first.
    parts : linear, factor and offset, (N,) each.
    target : (N,) by which the `table` of x (cells + 1,), even in it from the first of `values` to the second, is read.
    """
    linear, factor, offset = parts
    functions = _Increasing.of(
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
    """Return the smallest root in (0, `limit`] of polynomials (M, K) that do not vanish at zero, of the power zero
    first, or `limit` where there is none; NaN where one overflows."""
    return float(kernels().smallest_root(polynomials, limit))
