"""Inverting increasing functions point by point, and finding where a polynomial stops being increasing."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from rigkit.core.arrays import FloatArray, IntArray
from rigkit.core.errors import InputError

REAL_ROOT = 1e-7
"""A computed root whose imaginary part is below this share of its size is real: rounding splits a double root."""
LAST_STEP_REL = 1e-9
"""Newton doubles the digits at each step: after one this small, as a share of the range, all are right."""
QUICK_STEPS = 3
"""Newton steps from the table for all points; nearly all are done after two."""
RELATIVE_STEP = 1e-14
MAX_BISECTIONS = 60
"""The rest is bracketed: bisection alone reaches double precision in this many steps."""
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
    # Scaled to x in (0, 1] so that coefficients of high powers of pixels are not lost beside the others.
    degree = coefficients.shape[-1] - 1
    scaled = coefficients * limit ** np.arange(degree + 1.0)
    with np.errstate(over="ignore", divide="ignore", invalid="ignore"):
        last_row = scaled[..., 1:] / -scaled[..., :1]
    if not np.isfinite(last_row).all():
        raise InputError("lens polynomial: its coefficients are too large for any lens; calibrate again")
    # Eigenvalues of this companion matrix are 1 / x: a leading coefficient of zero is no special case.
    companion = np.zeros((*coefficients.shape[:-1], degree, degree))
    companion.reshape(-1, degree * degree)[:, degree :: degree + 1] = 1.0
    companion[..., 0, :] = last_row
    inverse = np.linalg.eigvals(companion)
    real = inverse.real[np.abs(inverse.imag) <= REAL_ROOT * np.abs(inverse)]
    return float(limit / real.max(initial=1.0))


def invert_increasing(
    function: Callable[[FloatArray, IntArray | None], tuple[FloatArray, FloatArray]],
    target: FloatArray,
    knots: FloatArray,
    values: FloatArray,
) -> FloatArray:
    """Return x with g(x) = target by Newton's method kept inside a bracket.

    Parameters
    ----------
    function : called with (x, index) where `index` says which of the targets are asked for (None: all); returns the
        residual, zero at the solution and increasing in x, and its derivative.
    target : (N,) values in [values[0], values[-1]]; the caller replaces what is outside, and NaN.
    knots, values : (K,) a table of the function, both increasing: it gives the bracket and the start.
    """
    x = _looked_up(target, knots, values)
    first, last = float(knots[0]), float(knots[-1])
    for step in range(QUICK_STEPS):
        residual, slope = function(x, None)
        move = residual / slope
        done = np.abs(move) <= LAST_STEP_REL * (last - first)
        x = np.clip(x - move, first, last)
        if step and done.all():
            return x
    index = np.flatnonzero(~done)
    low, high = np.full(index.size, first), np.full(index.size, last)
    # NaN (a slope of zero) must not be the start.
    x[index] = np.where(np.isfinite(x[index]), x[index], 0.5 * (first + last))
    for _ in range(MAX_BISECTIONS):
        old = x[index]
        residual, slope = function(old, index)
        above = residual > 0.0
        high = np.where(above, old, high)
        low = np.where(above, low, old)
        new = old - residual / slope
        new = np.where((new >= low) & (new <= high), new, 0.5 * (low + high))
        x[index] = new
        moving = np.abs(new - old) > RELATIVE_STEP * (last - first)
        if not moving.any():
            break
        index, low, high = index[moving], low[moving], high[moving]
    return x


def _looked_up(target: FloatArray, knots: FloatArray, values: FloatArray) -> FloatArray:
    """Return x from the table by linear interpolation in equal cells of the target."""
    cells = CELLS_PER_KNOT * (knots.size - 1)
    table = np.interp(np.linspace(values[0], values[-1], cells + 1), values, knots)
    position = (target - values[0]) * (cells / (values[-1] - values[0]))
    cell = np.clip(position.astype(np.int64), 0, cells - 1)
    left = table[cell]
    return np.asarray(left + (position - cell) * (table[cell + 1] - left))
