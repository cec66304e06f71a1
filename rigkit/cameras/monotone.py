"""Inverting increasing functions point by point, and finding where a polynomial stops being increasing."""

from __future__ import annotations

import math

import numpy as np

from rigkit.core.arrays import FloatArray
from rigkit.core.errors import InputError
from rigkit.kernels.monotone import inverses, smallest_root

CELLS_PER_KNOT = 4
"""The table is looked up in equal cells of the target, found by a division instead of a search."""

KNOTS = 129
"""Samples of a radial curve from which its inverse starts; Newton does the rest."""


def horner(coefficients: FloatArray, x: FloatArray) -> FloatArray:
    """Return sum_k coefficients[k] x^k."""
    *lower, top = coefficients.tolist()
    if not lower:
        return np.full_like(x, top)
    value: FloatArray = top * x
    value += lower.pop()
    for c in reversed(lower):
        value *= x
        value += c
    return value


def first_root(coefficients: FloatArray, limit: float) -> float:
    """Return the smallest root in (0, `limit`] of the polynomials sum_k coefficients[..., k] x^k, (..., K) of them, or
    `limit` where there is none. They must not vanish at zero.

    Raises InputError where a polynomial overflows: what a solver tries may be far from any lens.
    """
    root = smallest_root(np.atleast_2d(coefficients), limit)
    if math.isnan(root):
        raise InputError("lens polynomial: its coefficients are too large for any lens; calibrate again")
    return root


def invert_increasing(
    polynomial: FloatArray,
    parts: tuple[FloatArray, FloatArray, FloatArray],
    target: FloatArray,
    knots: FloatArray,
    values: FloatArray,
) -> FloatArray:
    """Return x (N,) with linear x + factor P(x) = offset, where that increases in x, by Newton's method kept inside a
    bracket.

    Parameters
    ----------
    polynomial : coefficients of P, of the power zero first.
    parts : linear, factor and offset, (N,) each.
    target : (N,) values in [values[0], values[-1]] of a function of x; the caller replaces what is outside, and NaN.
    knots, values : (K,) a table of that function, both increasing: it gives the bracket and the start.
    """
    cells = CELLS_PER_KNOT * (knots.size - 1)
    ends = float(values[0]), float(values[-1])
    table = np.interp(np.linspace(*ends, cells + 1), values, knots)
    return inverses(polynomial, parts, target, table, ends, (float(knots[0]), float(knots[-1])))
