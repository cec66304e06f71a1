"""Which corner of a lattice is the first, as far as one image can tell.

Convention: the square diagonally outside the first corner, at grid (-1..0, -1..0), is BLACK, and the board has its
known size, columns x rows (columns >= rows where no size is known). That leaves one choice where columns + rows is odd,
two where it is even (the board looks the same turned by 180 degrees), and up to four for square boards. What is left is
settled by the image: the choice whose columns and rows run most nearly to the right and down.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from rigkit.corners.lattice import Lattice

__all__ = ["orient"]


def orient(lattice: Lattice, sizes: Sequence[tuple[int, int]] = ()) -> Lattice:
    """Return `lattice` turned so that its first corner follows the convention; `sizes` are the known (columns, rows)."""
    turns = [lattice.turned(quarter) for quarter in range(4)]
    of_size = [turn for turn in turns if turn.size in sizes] or [turn for turn in turns if turn.size[0] >= turn.size[1]]
    dark = [turn for turn in of_size if not turn.rising] or of_size
    return max(dark, key=_downwards)


def _downwards(lattice: Lattice) -> float:
    """Return how far columns and rows run to the right and down: mean step along (1, 1), in the larger mean step."""
    column = np.nanmean(np.diff(lattice.pixels, axis=1), axis=(0, 1))
    row = np.nanmean(np.diff(lattice.pixels, axis=0), axis=(0, 1))
    longest = max(float(np.linalg.norm(column)), float(np.linalg.norm(row)), 1e-9)
    return round(float((column + row).sum()) / longest, 9)
