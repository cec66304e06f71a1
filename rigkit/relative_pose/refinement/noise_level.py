"""How noisy a pair's corners are: what their own residuals show, and what was stated where they are few."""

from __future__ import annotations

POSE_FREEDOM = 5
"""Degrees of freedom of a relative pose without its length."""
STATED_RESIDUALS = 2.0
"""The stated sigmas count as much as one more corner in one image: a unit-information prior (Kass and Wasserman, J. Am.
Stat. Assoc. 90, 1995) on the variance, conjugate as a scaled inverse chi-square. A handful of residuals that happen to
be small proves little, a hundred say how noisy the corners are, in either direction."""


def variance_factor(sum_of_squares: float, freedom: int) -> float:
    """Return observed over stated variance from residuals in stated sigmas.

    `freedom` is their number less the parameters fitted to them; with none it is 1, what was stated.
    """
    freedom = max(freedom, 0)
    return (sum_of_squares * (freedom > 0) + STATED_RESIDUALS) / (freedom + STATED_RESIDUALS)
