"""Inverting increasing functions point by point, and finding where a polynomial stops being increasing."""

from __future__ import annotations

import math

import numpy as np

from rigkit.core.arrays import FloatArray
from rigkit.core.errors import InputError
from rigkit.kernels.monotone import inverses, smallest_root

CELLS_PER_KNOT = 4
"""Resolution of the table of initial values: equal cells of the target, found by a division instead of a search."""

KNOTS = 129
"""Samples of a radial curve that give initial values of its inverse for Newton's method."""


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
    """Return the smallest root in (0, `limit`] of all the polynomials sum_k coefficients[..., k] x^k, or `limit` if
    there is none. They must not vanish at zero.

    Raises InputError where a polynomial overflows: a solver may try parameters far from any lens.
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
    """Return x (N,) with linear x + factor P(x) = offset, where that increases in x, by Newton's method in a bracket.

    Parameters
    ----------
    polynomial : coefficients of P, of the power zero first.
    parts : linear, factor and offset, (N,) each.
    target : (N,) values in [values[0], values[-1]] of a function of x; the caller has to replace others and NaN.
    knots, values : (K,) a table of that function, both increasing, for brackets and initial values.
    """
    cells = CELLS_PER_KNOT * (knots.size - 1)
    ends = float(values[0]), float(values[-1])
    table = np.interp(np.linspace(*ends, cells + 1), values, knots)
    return inverses(polynomial, parts, target, table, ends, (float(knots[0]), float(knots[-1])))
