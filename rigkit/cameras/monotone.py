"""Inverting increasing functions point by point, and finding where a polynomial stops being increasing."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from rigkit.arrays import FloatArray

__all__ = ["first_root", "horner", "invert_increasing"]

REAL_ROOT = 1e-7
"""A computed root whose imaginary part is below this share of its size is real: rounding splits a double root."""
STEP_REL = 1e-14
"""Newton stops at steps of a few units in the last place."""
ALL_STEPS = 4
"""Nearly all points converge in this many steps; later steps only touch the rest."""
MAX_STEPS = 60
"""Bisection alone reaches double precision in this many."""


def horner(coefficients: FloatArray, x: FloatArray) -> FloatArray:
    """Return sum_k coefficients[k] x^k."""
    value = np.full_like(x, coefficients[-1])
    for c in coefficients[-2::-1]:
        value *= x
        value += c
    return value


def first_root(coefficients: FloatArray, limit: float) -> float:
    """Return the smallest root in (0, `limit`] of sum_k coefficients[k] x^k, or `limit` where there is none."""
    # Scaled to x in (0, 1] so that coefficients of high powers of pixels are not lost beside the others.
    scaled = np.asarray(coefficients, dtype=np.float64) * limit ** np.arange(len(coefficients), dtype=np.float64)
    roots = np.roots(np.trim_zeros(scaled[::-1], "f"))
    real = roots.real[np.abs(roots.imag) <= REAL_ROOT * np.abs(roots)]
    real = real[(real > 0.0) & (real < 1.0)]
    return float(limit * real.min()) if real.size else float(limit)


def invert_increasing(
    function: Callable[[FloatArray, FloatArray | None], tuple[FloatArray, FloatArray]],
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
    cell = np.clip(np.searchsorted(values, target, side="right") - 1, 0, knots.size - 2)
    low, high = knots[cell], knots[cell + 1]
    share = (target - values[cell]) / (values[cell + 1] - values[cell])
    x = low + np.clip(share, 0.0, 1.0) * (high - low)
    scale = STEP_REL * knots[-1]
    index: np.ndarray | None = None
    for step in range(MAX_STEPS):
        old = x if index is None else x[index]
        residual, slope = function(old, index)
        above = residual > 0.0
        high = np.where(above, old, high)
        low = np.where(above, low, old)
        new = old - residual / slope
        new = np.where((new >= low) & (new <= high), new, 0.5 * (low + high))
        if index is None:
            x = new
        else:
            x[index] = new
        moving = np.abs(new - old) > scale
        if not moving.any():
            break
        if step >= ALL_STEPS:
            index = np.flatnonzero(moving) if index is None else index[moving]
            low, high = low[moving], high[moving]
    return x
