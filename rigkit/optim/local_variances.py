"""Empirical Bayes estimates of the variances of many small samples.

The variance of a small sample is unbiased but noisy; that of all samples is accurate but may be wrong for one of them.
How much the sample variances differ determines the weights of the two (G. K. Smyth, "Linear Models and Empirical Bayes
Methods", Statistical Applications in Genetics and Molecular Biology 3, 2004, section 6.2).
"""

from __future__ import annotations

import functools

import numpy as np

from rigkit.core.arrays import FloatArray

LARGEST_SCATTER = 100.0
"""Largest variance in the table of `of_redescending`."""
SAMPLED_LENGTHS = 400
"""Samples of the integral over distances: variances are accurate to a thousandth."""


def shrunk_variances(variances: FloatArray, freedom: FloatArray) -> FloatArray:
    """Return the variances (N,) of samples with `freedom` (N,) degrees of freedom, shrunk towards a common one.

    Notes
    -----
    The prior of the true variances is a scaled inverse chi-square distribution with d0 degrees of freedom about s0^2.
    The mean of log s^2, and its variance less that expected from `freedom`, give d0 and s0^2 (Smyth's equations for
    e_g); each variance becomes (d0 s0^2 + d s^2) / (d0 + d). Zero variances are not used for the prior.
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
    """Return the variances (...) from mean squares per component weighted by the Geman-McClure loss.

    `scatter` is sum w s^2 / (3 sum w) over distances s of three components, w = 1 / (1 + s^2 / (3 turn^2))^2. As large
    distances have small weights it is less than the variance, and the more so the larger that is.
    """
    left, variances = _table(turn)
    return np.asarray(np.interp(scatter, left, variances))


@functools.cache
def _table(turn: float) -> tuple[FloatArray, FloatArray]:
    """Return the weighted mean squares (M,), increasing, of variances (M,)."""
    variances = np.geomspace(1.0 / LARGEST_SCATTER, LARGEST_SCATTER, 200)
    # The Maxwell distribution, of the length of three Gaussians of variance 1.
    length = np.linspace(0.0, 7.0, SAMPLED_LENGTHS)
    density = length**2 * np.exp(-0.5 * length**2)
    square = variances[:, None] * length**2
    weight = density / (1.0 + square / (3.0 * turn**2)) ** 2
    left = np.sum(weight * square, axis=1) / (3.0 * np.sum(weight, axis=1))
    return np.concatenate([[0.0], left]), np.concatenate([[0.0], variances])
