"""How evenly the rows and columns of a lattice run: how neighbouring steps along them differ."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from rigkit.core.arrays import FloatArray
from rigkit.kernels import lattice as native

__all__ = ["SpacingChange", "spacing_changes"]


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
    library = native.loaded()
    if library is None:
        return _changes_along_rows(pixels), _changes_along_rows(pixels.swapaxes(0, 1))
    typical, seen, every = native.uneven_steps(pixels)
    inner = max(pixels.shape[1] - 2, 0)
    return SpacingChange(typical[:inner], seen[:inner], every[0]), SpacingChange(
        typical[inner:], seen[inner:], every[1]
    )


def _changes_along_rows(pixels: FloatArray) -> SpacingChange:
    columns = pixels.shape[1]
    if columns < 3:
        return SpacingChange([], [], np.nan)
    step = pixels[:, 1:] - pixels[:, :-1]
    bend = step[:, 1:] - step[:, :-1]
    length = np.hypot(step[..., 0], step[..., 1])
    with np.errstate(divide="ignore", invalid="ignore"):
        relative = np.hypot(bend[..., 0], bend[..., 1]) / np.minimum(length[:, 1:], length[:, :-1])
    here = [column[np.isfinite(column)] for column in relative.T]
    every = np.sort(np.concatenate(here))
    return SpacingChange(
        [float(np.median(column)) if len(column) else np.nan for column in here],
        [len(column) for column in here],
        float(every[len(every) // 2]) if len(every) else np.nan,
    )
