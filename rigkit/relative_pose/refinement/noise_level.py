"""The variance factor of a pair's corners, from their residuals and a prior on their stated sigmas."""

from __future__ import annotations

POSE_FREEDOM = 5
"""Degrees of freedom of a relative pose without its length."""
STATED_RESIDUALS = 2.0
"""Weight of the stated sigmas in residuals, those of one corner in one image: a unit-information prior (Kass and
Wasserman, J. Am. Stat. Assoc. 90, 1995) on the variance, conjugate as a scaled inverse chi-square."""


def variance_factor(sum_of_squares: float, freedom: int) -> float:
    """Return the posterior mean of observed over stated variance, 1 without redundancy.

    `sum_of_squares` is that of the residuals in stated sigmas, `freedom` their number less that of fitted parameters.
    """
    freedom = max(freedom, 0)
    return (sum_of_squares * (freedom > 0) + STATED_RESIDUALS) / (freedom + STATED_RESIDUALS)
