"""Which corner of a lattice is the first, as far as one image can tell.

Convention: the square diagonally outside the first corner, at grid (-1..0, -1..0), is BLACK, and the board has its
known size, columns x rows (columns >= rows where no size is known). That leaves one choice where columns + rows is odd,
two where it is even (the board looks the same turned by 180 degrees), and up to four for square boards. What is left is
settled by the image: the choice whose columns and rows run most nearly to the right and down.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from rigkit.arrays import FloatArray
from rigkit.corners.lattice import Lattice

__all__ = ["quarter_turns"]


def quarter_turns(lattice: Lattice, sizes: Sequence[tuple[int, int]] = ()) -> int:
    """Return by how many quarter turns `lattice` follows the convention; `sizes` are the known (columns, rows)."""
    turns = [lattice.turned(quarter) for quarter in range(4)]
    fits = [turn.size in sizes for turn in turns]
    if not any(fits):
        fits = [turn.size[0] >= turn.size[1] for turn in turns]
    dark = [fit and not turn.rising for fit, turn in zip(fits, turns, strict=True)]
    allowed = dark if any(dark) else fits
    return max((q for q in range(4) if allowed[q]), key=lambda q: (_downwards(turns[q]), -q))


def _downwards(lattice: Lattice) -> float:
    """Return how far columns and rows run to the right and down: mean step along (1, 1), in the larger mean step."""
    column, row = (_mean_step(np.diff(lattice.pixels, axis=axis)) for axis in (1, 0))
    longest = max(float(np.linalg.norm(column)), float(np.linalg.norm(row)), 1e-9)
    return round(float((column + row).sum()) / longest, 9)


def _mean_step(steps: FloatArray) -> FloatArray:
    known = np.isfinite(steps[..., 0])
    mean: FloatArray = steps[known].mean(axis=0) if known.any() else np.zeros(2)
    return mean
