"""Where in a board the circles of a lattice lie: by the board's size, and by what is seen beside them to be paper.

A lattice may be numbered from several ends: four of a square one, six of a hexagonal one. Of all the places that it can
have in the board those are right that leave no place of the board empty which the image shows. A whole board has one
such place (or several that look the same), a part as many as its own borders leave open.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from rigkit.core.arrays import BoolArray, FloatArray, IntArray
from rigkit.core.boards import Board
from rigkit.core.detections import BoardDetection, grid_turned
from rigkit.core.patterns.circles import Circles
from rigkit.detection.circles.find import CircleGrid

MAX_EMPTY_DIFFERENCE = 2
"""A place in a board is preferred to another in it that leaves more than so many more places empty."""
MAX_EMPTY = 0.2
"""Part of a board's circles that may be covered where the others show their place."""
EMPTY_LINE = 0.5
"""A line of the board beside the circles, of which this part is seen to be paper, is not there: it is another board."""


@dataclass(frozen=True, eq=False, slots=True)
class _Place:
    """A place of a lattice in a board: cells (N, 2) of the index grid, and how many other cells are seen empty."""

    grid: IntArray
    empty: int


def boards_meant(found: CircleGrid, boards: Sequence[Board]) -> list[tuple[Board, BoardDetection]]:
    """Return which of the boards the lattice can be, the likeliest first, each with the circles on its grid, unnamed.

    They are those that leave fewest places empty which the image shows: where the image's border cuts off the corner of
    a board, the paper beside it is seen, where a larger board would have circles. A lattice that is a whole board comes
    first, and after it larger boards that it may be a part of, in whatever place, where the image's border cuts these.
    """
    fits = [(board, place) for board in boards if (place := _place_on(found, board)) is not None]
    least = min((place.empty for _, place in fits), default=0)
    likely = [fit for fit in fits if fit[1].empty == least]
    whole = [(board, place) for board, place in fits if len(place.grid) == board.corner_count]
    if whole:
        others = [
            (board, _open_place(found, board, 0)) for board in boards if all(board is not own for own, _ in whole)
        ]
        likely = whole + [(board, place) for board, place in others if place is not None]
    return [(board, _detection(found, place.grid, board.size)) for board, place in likely]


def may_be_part(found: CircleGrid, board: Board) -> bool:
    """Return whether the lattice can be a part of the board, of which the image's border cuts off the rest."""
    return _open_place(found, board, MAX_EMPTY_DIFFERENCE) is not None


def _open_place(found: CircleGrid, board: Board, max_empty: int) -> _Place | None:
    """Return a place in the board that leaves at most `max_empty` places empty that the image shows; None where there
    is none."""
    fullest = min(_places_on(found, board), key=lambda place: place.empty, default=None)
    return None if fullest is None or fullest.empty > max_empty else fullest


def placed_on(found: CircleGrid, board: Board) -> BoardDetection | None:
    """Return the circles on the board's grid, unnamed, or None where the image does not tell their place."""
    place = _place_on(found, board)
    return None if place is None else _detection(found, place.grid, board.size)


def _place_on(found: CircleGrid, board: Board) -> _Place | None:
    places = _places_on(found, board)
    if not places:
        return None
    least = min(place.empty for place in places)
    if least > MAX_EMPTY * board.corner_count:
        return None
    good = [place for place in places if place.empty <= least + MAX_EMPTY_DIFFERENCE]
    if len({_key(place.grid, board) for place in good}) > 1:
        return None
    return max(good, key=lambda place: _upright(place.grid, found.pixels))


def _places_on(found: CircleGrid, board: Board) -> list[_Place]:
    """Return all places in the board that the lattice can have."""
    pattern = board.pattern
    if not isinstance(pattern, Circles) or pattern.inverted != found.bright:
        return []
    return [place for circles, empty in _counted(found, pattern.layout) for place in _places(circles, empty, board)]


def lone_part(found: CircleGrid, board: Board) -> BoardDetection | None:
    """Return the circles on a grid of their own where they can be a part of the board, else None."""
    pattern = board.pattern
    if not isinstance(pattern, Circles) or pattern.inverted != found.bright:
        return None
    best = None
    for circles, _ in _counted(found, pattern.layout):
        grid = _cells(circles - circles.min(axis=0), pattern)
        if (grid.max(axis=0) < board.size).all() and (best is None or _upright(grid, found.pixels) > best[0]):
            best = (_upright(grid, found.pixels), grid)
    if best is None:
        return None
    columns, rows = (best[1].max(axis=0) + 1).tolist()
    return _detection(found, best[1], (columns, rows))


def _counted(found: CircleGrid, layout: str) -> Iterator[tuple[IntArray, IntArray]]:
    """Yield the circles and the empty places as (column, row), or, staggered, as (half column, row), in all turns.

    Right-handed like the labels; not from zero. A lattice of the other kind has none.
    """
    if found.hexagonal != (layout == "hexagonal"):
        return
    label, empty = found.label, found.empty
    for _ in range(6 if found.hexagonal else 4):
        if found.hexagonal:
            yield tuple(np.stack([2 * p + q, q], axis=-1) for p, q in (label.T, empty.T))  # type: ignore[misc]
            # 60 degrees on: a becomes b, b becomes b - a.
            label, empty = (np.stack([p + q, -p], axis=-1) for p, q in (label.T, empty.T))
        else:
            if layout == "asymmetric":
                yield tuple(np.stack([p - q, p + q], axis=-1) for p, q in (label.T, empty.T))  # type: ignore[misc]
            else:
                yield label, empty
            label, empty = (np.stack([-q, p], axis=-1) for p, q in (label.T, empty.T))


def _cells(circles: IntArray, pattern: Circles) -> IntArray:
    """Return (column, row) of circles given as (half column, row) from zero, or just so in a regular layout."""
    if not pattern.staggered:
        return circles
    half, row = circles.T
    if ((half[0] + row[0]) % 2 == 0) != (pattern.stagger == "right"):
        half = half + 1
    return np.stack([half // 2, row], axis=-1)


def _places(circles: IntArray, empty: IntArray, board: Board) -> Iterator[_Place]:
    """Yield the places in the board that circles of one numbering can have."""
    pattern = board.pattern
    staggered = isinstance(pattern, Circles) and pattern.staggered
    columns, rows = board.size
    wide = 2 * columns if staggered else columns
    there = np.ones((rows, wide), bool)
    if staggered:
        row, half = np.indices(there.shape)
        there = (row + half) % 2 == int(isinstance(pattern, Circles) and pattern.stagger == "left")
    low, extent = circles.min(axis=0), np.ptp(circles, axis=0) + 1
    for across in range(wide - extent[0] + 1):
        for down in range(rows - extent[1] + 1):
            shift = np.array([across, down]) - low
            at = circles + shift
            if not there[at[:, 1], at[:, 0]].all():
                continue
            beside = empty + shift
            inside = ((beside >= 0) & (beside < [wide, rows])).all(axis=1)
            beside = beside[inside]
            beside = beside[there[beside[:, 1], beside[:, 0]]]
            if _empty_line(at, beside, there):
                continue
            left = len(beside)
            yield _Place(np.stack([at[:, 0] // 2 if staggered else at[:, 0], at[:, 1]], axis=-1), left)


def _empty_line(at: IntArray, empty: IntArray, there: BoolArray) -> bool:
    """Return whether the line of the board before or after all circles `at` is seen, and is empty."""
    for axis, points in enumerate((there.sum(axis=0), there.sum(axis=1))):
        for line in (at[:, axis].min() - 1, at[:, axis].max() + 1):
            if 0 <= line < len(points) and (empty[:, axis] == line).sum() > EMPTY_LINE * points[line]:
                return True
    return False


def _key(grid: IntArray, board: Board) -> tuple[int, ...]:
    """Return what is the same for all places that look the same when the board is turned: which cells are taken."""
    turned = (grid_turned(grid, board.size, turns) for turns in (0, *board.turns))
    return min(tuple(np.sort(cells @ [1, board.columns]).tolist()) for cells in turned)


def _upright(grid: IntArray, pixels: FloatArray) -> float:
    """Return how nearly columns run to the right and rows down."""
    centred = grid - grid.mean(axis=0)
    slope = np.linalg.lstsq(centred.astype(np.float64), pixels - pixels.mean(axis=0), rcond=None)[0]
    slope = slope / np.maximum(np.linalg.norm(slope, axis=1, keepdims=True), 1e-12)
    return float(slope[0, 0] + slope[1, 1])


def _detection(found: CircleGrid, grid: IntArray, size: tuple[int, int]) -> BoardDetection:
    order = np.lexsort(grid.T)
    return BoardDetection(None, *size, grid[order], found.pixels[order], found.sigma_px[order])
