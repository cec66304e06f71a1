"""Unknown circle grids: layout, size, polarity and size of the circles, from the grids found in images."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np

from rigkit.core.boards import Board
from rigkit.core.patterns.circles import NEIGHBOUR_DISTANCES, STAGGERS, Circles
from rigkit.detection.circles.find import MIN_SIDE
from rigkit.detection.circles.grid import CircleGrid
from rigkit.detection.circles.place import may_be_part, placed_on
from rigkit.detection.circles.search import find_grids
from rigkit.detection.saddles.response import GreyImage


@dataclass(eq=False, slots=True)
class CircleObservations:
    """The grids of circles of all images.

    Attributes
    ----------
    boards : number of images with each whole board, of distance 1 mm, without the circles' size.
    bounded : number of these in which the board cannot extend beyond the image's border.
    diameters : of the circles, in distances of neighbours.
    shown : index of each image with a whole grid, and the boards that this can be.
    """

    boards: Counter[tuple[str, int, int, str, bool]] = field(default_factory=Counter)
    bounded: Counter[tuple[str, int, int, str, bool]] = field(default_factory=Counter)
    diameters: list[float] = field(default_factory=list)
    shown: list[tuple[int, set[tuple[str, int, int, str, bool]]]] = field(default_factory=list)

    def look(self, index: int, image: GreyImage) -> bool:
        """Search an image for grids; return whether it has a whole one."""
        grids = find_grids(image)
        if not grids:
            return False
        fits = {kind for kind in _kinds(grids[0]) if _whole(grids[0], kind)}
        self.boards.update(fits)
        self.bounded.update(kind for kind in fits if not _goes_on(grids[0], kind))
        if fits:
            self.diameters.append(2.0 * grids[0].radius)
            self.shown.append((index, fits))
        return bool(fits)


def _kinds(grid: CircleGrid) -> Iterator[tuple[str, int, int, str, bool]]:
    """Yield layout, columns, rows, stagger and polarity of the boards with as many circles."""
    count = len(grid)
    for rows in range(MIN_SIDE, count // MIN_SIDE + 1):
        if count % rows:
            continue
        columns = count // rows
        if grid.hexagonal:
            yield from (("hexagonal", columns, rows, stagger, grid.bright) for stagger in STAGGERS)
            continue
        # Rotated by 90 degrees, a regular grid is the same with rows and columns exchanged.
        if columns >= rows:
            yield "regular", columns, rows, STAGGERS[0], grid.bright
        yield from (("asymmetric", columns, rows, stagger, grid.bright) for stagger in STAGGERS)


def _board(kind: tuple[str, int, int, str, bool], diameter_mm: float | None = None) -> Board:
    layout, columns, rows, stagger, inverted = kind
    return Board("board", columns, rows, 1.0, 1.0, pattern=Circles(layout, stagger, diameter_mm, inverted))


def _whole(grid: CircleGrid, kind: tuple[str, int, int, str, bool]) -> bool:
    placed = placed_on(grid, _board(kind))
    return placed is not None and placed.complete


def _goes_on(grid: CircleGrid, kind: tuple[str, int, int, str, bool]) -> bool:
    """Return whether the image's border may cut off another row or column."""
    layout, columns, rows, _, bright = kind
    staggers = STAGGERS if layout != "regular" else STAGGERS[:1]
    larger = ((columns + 1, rows), (columns, rows + 1))
    return any(may_be_part(grid, _board((layout, *size, stagger, bright))) for size in larger for stagger in staggers)


def guessed_circles(seen: CircleObservations) -> tuple[Board, tuple[int, ...]] | None:
    """Return the grid that most images show whole, with circles 1 mm apart in a row, and their indices; None for none.

    Images with paper all around it have priority: a grid cut by the border of an image looks like a whole one with
    fewer rows. If there are none, or as many, the larger grid is the whole one. A grid that looks the same from its
    other end is reported as staggered to the right.
    """
    if not seen.boards:
        return None
    best = max(
        seen.boards,
        key=lambda kind: (
            *(seen.bounded[kind], seen.boards[kind], kind[1] * kind[2]),
            *(kind[0] == "regular", -STAGGERS.index(kind[3]), kind),
        ),
    )
    diameter = round(float(np.median(seen.diameters)) * NEIGHBOUR_DISTANCES[best[0]], 2)
    return _board(best, diameter), tuple(index for index, fits in seen.shown if best in fits)
