"""Variances of many small samples, each by its own scatter as far as the samples differ by more than chance.

A sample's own variance is honest but noisy; what all have in common is sure but may not be its own. How much the
samples differ says how much of either to take (G. K. Smyth, "Linear Models and Empirical Bayes Methods", Statistical
Applications in Genetics and Molecular Biology 3, 2004, section 6.2).
"""

from __future__ import annotations

import functools

import numpy as np

from rigkit.core.arrays import FloatArray

LARGEST_SCATTER = 100.0
"""Variance up to which `of_redescending` knows what is left of it."""
SAMPLED_LENGTHS = 400
"""Of the integral over distances: variances come out to a thousandth."""


def shrunk_variances(variances: FloatArray, freedom: FloatArray) -> FloatArray:
    """Return the variances (N,) of samples of `freedom` (N,) degrees, drawn towards the one they have in common.

    Notes
    -----
    With a scaled inverse chi-square distribution of the true ones, of d0 degrees about s0^2, the mean of log s^2 and
    its variance beyond what `freedom` explains give d0 and s0^2 (Smyth's equations for e_g); each becomes
    (d0 s0^2 + d s^2) / (d0 + d). Zeros say nothing of themselves; they get what is common.
    """
    from scipy.special import digamma, polygamma

    known = variances > 0.0
    if np.count_nonzero(known) < 2:
        return np.array(variances, dtype=np.float64)
    half = 0.5 * freedom[known]
    logs = np.log(variances[known]) - digamma(half) + np.log(half)
    beyond = float(np.var(logs, ddof=1) - np.mean(polygamma(1, half)))
    if beyond <= 0.0:
        return np.full(len(variances), np.exp(np.mean(logs)))
    prior = _inverse_trigamma(beyond)
    common = np.exp(np.mean(logs) + digamma(prior) - np.log(prior))
    return np.asarray((2.0 * prior * common + freedom * variances) / (2.0 * prior + freedom))


def _inverse_trigamma(value: float) -> float:
    """Return x > 0 with trigamma(x) = value, by Newton's method for 1 / trigamma, which is nearly straight (Smyth)."""
    from scipy.special import polygamma

    x = 0.5 + 1.0 / value
    for _ in range(50):
        at = float(polygamma(1, x))
        step = at * (1.0 - at / value) / float(polygamma(2, x))
        x += step
        if -step < 1e-9 * x:
            break
    return x


def of_redescending(scatter: FloatArray, turn: float) -> FloatArray:
    """Return the variances (...) of which the loss of Geman and McClure leaves such a mean square a component.

    `scatter` is sum w s^2 / (3 sum w) over distances s of three components, w = 1 / (1 + s^2 / (3 turn^2))^2: what is
    far off counts little, so that it is less than the variance, and the more so the larger that is.
    """
    left, variances = _table(turn)
    return np.asarray(np.interp(scatter, left, variances))


@functools.cache
def _table(turn: float) -> tuple[FloatArray, FloatArray]:
    """Return what is left (M,), rising, of variances (M,)."""
    variances = np.geomspace(1.0 / LARGEST_SCATTER, LARGEST_SCATTER, 200)
    # Maxwell's distribution, of the length of three Gaussians of variance 1.
    length = np.linspace(0.0, 7.0, SAMPLED_LENGTHS)
    density = length**2 * np.exp(-0.5 * length**2)
    square = variances[:, None] * length**2
    weight = density / (1.0 + square / (3.0 * turn**2)) ** 2
    left = np.sum(weight * square, axis=1) / (3.0 * np.sum(weight, axis=1))
    return np.concatenate([[0.0], left]), np.concatenate([[0.0], variances])
