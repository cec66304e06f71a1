"""How evenly the rows and columns of a lattice run: how neighbouring steps along them differ."""

from __future__ import annotations

from typing import NamedTuple

from rigkit.core.arrays import FloatArray
from rigkit.kernels import lattice as native


class SpacingChange(NamedTuple):
    """How the steps before and after the inner corners of the rows differ, relative to the shorter step.

    Attributes
    ----------
    typical : the median of each inner column, NaN where nothing is known; seen : the number of corners behind it.
    every : the (upper) median of all, NaN likewise.
    """

    typical: list[float]
    seen: list[int]
    every: float


def spacing_changes(pixels: FloatArray) -> tuple[SpacingChange, SpacingChange]:
    """Return how uneven the rows of `pixels` (R, C, 2) are, and its columns; NaN where no corner is known."""
    typical, seen, every = native.uneven_steps(pixels)
    inner = max(pixels.shape[1] - 2, 0)
    return SpacingChange(typical[:inner], seen[:inner], every[0]), SpacingChange(
        typical[inner:], seen[inner:], every[1]
    )
