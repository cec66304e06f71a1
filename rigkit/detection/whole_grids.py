"""How large a chessboard is, from grids of which the frame may cut every one."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from rigkit.core.arrays import FloatArray
from rigkit.core.detections import BoardDetection

MIN_SHARE_OF_LINE = 0.5
"""A grid ends where this part of its next line would be seen, but is not: the frame may hide the rest."""

MIN_SHARE_OF_GRID = 0.8
"""A grid has this part of its corners, or may be two boards in one: marks in squares hide few."""

MIN_SURE_CORNERS = 20
"""Lattices of as many corners are no chance."""

UNSEEN_BORDER_PX = 5.0
"""Corners nearer to the image's border may be missed (sharp ones are found from 3 px on): a grid may go on there."""

Size = tuple[int, int]
"""Corners along the longer side of a grid, and along the other."""


@dataclass(frozen=True, slots=True)
class GridSeen:
    """How far a grid goes, along its columns and rows, and whether it ends there: else the frame cuts it."""

    lengths: tuple[int, int]
    ends: tuple[bool, bool]

    @property
    def size(self) -> Size:
        return max(self.lengths), min(self.lengths)

    @property
    def whole(self) -> bool:
        return all(self.ends)

    def may_be_of(self, size: Size) -> bool:
        """Say whether a board of this size looks like that where the frame cuts it."""
        return any(
            all(
                length == side if ends else length <= side
                for length, ends, side in zip(self.lengths, self.ends, sides, strict=True)
            )
            for sides in (size, size[::-1])
        )


def grid_seen(found: BoardDetection, shape: tuple[int, int]) -> GridSeen | None:
    """Return how far a grid goes in an image of so many rows and columns; None where it is no more than a patch."""
    if not found.complete and len(found.grid) < max(MIN_SURE_CORNERS, MIN_SHARE_OF_GRID * found.columns * found.rows):
        return None
    lattice = found.lattice()
    borders = np.array(shape[::-1]) - 1.0
    along_columns = lattice.transpose(1, 0, 2)
    ends = tuple(_ends(lines, borders) and _ends(lines[::-1], borders) for lines in (along_columns, lattice))
    return GridSeen((found.columns, found.rows), (ends[0], ends[1]))


def _ends(lines: FloatArray, borders: FloatArray) -> bool:
    """Say whether the corners of a grid (lines, corners of each, 2), NaN where there is none, end with the first line:
    what would be the next line is in the image, and was not found there."""
    first, second, third = (lines[k] if k < len(lines) else np.full_like(lines[0], np.nan) for k in range(3))
    # Lenses bend lines; where the third corner is missing they are taken for straight.
    bend = np.nan_to_num(first - 2.0 * second + third)
    beyond = 2.0 * first - second + bend
    # Corners that are missing are NaN, and not inside.
    inside = ((beyond >= UNSEEN_BORDER_PX) & (beyond <= borders - UNSEEN_BORDER_PX)).all(axis=1)
    return bool(np.count_nonzero(inside) >= MIN_SHARE_OF_LINE * lines.shape[1])


def whole_sizes(seen: Sequence[GridSeen]) -> set[Size]:
    """Return the sizes of an image's grids that the frame does not cut."""
    return {grid.size for grid in seen if grid.whole}


def size_of_parts(plain: Sequence[Sequence[GridSeen]], min_images: int) -> tuple[Size, tuple[int, ...]] | None:
    """Return the size of the board of which images show parts, and the images that show where one of its sides ends;
    None where they do not show both.

    plain : the grids of each image. Each side of the board is seen from end to end in `min_images` or more, and no
    size explains more images. Parts of a board as long as wide do not tell which of its sides they show.
    """
    lengths = sorted({n for grids in plain for g in grids for n, ends in zip(g.lengths, g.ends, strict=True) if ends})
    best: tuple[int, Size, tuple[int, ...]] | None = None
    for size in ((long, short) for long in lengths for short in lengths if long > short):
        fit = [[g for g in grids if any(g.ends) and g.may_be_of(size)] for grids in plain]
        shown = tuple(k for k, grids in enumerate(fit) if grids)
        told = Counter(side for grids in fit for side in _sides_told(grids, size))
        if min(told[0], told[1]) >= min_images and (best is None or len(shown) > best[0]):
            best = len(shown), size, shown
    return None if best is None else best[1:]


def _sides_told(grids: Sequence[GridSeen], size: Size) -> set[int]:
    """Return which sides (0 : the longer, 1) of a board of this size an image's grids show from end to end."""
    whole = {n for g in grids for n, ends in zip(g.lengths, g.ends, strict=True) if ends}
    return {k for k, side in enumerate(size) if side in whole}
