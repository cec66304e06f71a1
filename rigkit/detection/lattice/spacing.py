"""Differences of successive steps along the rows and columns of a lattice."""

from __future__ import annotations

from typing import NamedTuple

from rigkit.core.arrays import FloatArray
from rigkit.kernels import lattice as native


class SpacingChange(NamedTuple):
    """Difference of the steps before and after inner corners of the rows, relative to the shorter step.

    Attributes
    ----------
    typical : median over each inner column, NaN where unknown; seen : its number of corners.
    every : the (upper) median of all, NaN likewise.
    """

    typical: list[float]
    seen: list[int]
    every: float


def spacing_changes(pixels: FloatArray) -> tuple[SpacingChange, SpacingChange]:
    """Return the differences along the rows and along the columns of `pixels` (R, C, 2), NaN where unknown."""
    typical, seen, every = native.uneven_steps(pixels)
    inner = max(pixels.shape[1] - 2, 0)
    rows, columns = slice(0, inner), slice(inner, None)
    return (
        SpacingChange(typical[rows], seen[rows], every[0]),
        SpacingChange(typical[columns], seen[columns], every[1]),
    )
