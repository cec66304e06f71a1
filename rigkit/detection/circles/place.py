"""The place of a lattice of circles on a board, from the board's size and from empty places beside the lattice.

A lattice may be numbered from several ends: a square one from four, a hexagonal one from six. Of all its places on the
board those are right that leave no visible place of the board empty. A whole board has one such place (or several that
look the same), a part has as many as its own borders leave open.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from rigkit.core.arrays import BoolArray, FloatArray, IntArray
from rigkit.core.boards import Board
from rigkit.core.detections import BoardDetection, grid_turned
from rigkit.core.patterns.circles import Circles
from rigkit.detection.circles.grid import CircleGrid

MAX_EMPTY_DIFFERENCE = 2
"""A place on a board is preferred to another one that leaves more than this number of further places empty."""
MAX_EMPTY = 0.2
"""Largest share of a board's circles that may be covered if the others determine their place."""
EMPTY_LINE = 0.5
"""Share of a line of the board beside the circles that is visible and empty, above which it is another board."""
STRAY_CIRCLES = 1
"""Largest number of circles in a line beyond the board, mostly visible and empty, that do not belong to it: something
round beside the board. A second one in a place of the lattice is no chance: the board is larger."""


@dataclass(frozen=True, eq=False, slots=True)
class _Place:
    """A place of a lattice on a board.

    Attributes
    ----------
    grid : (M, 2) cells of the index grid.
    kept : (N,) which circles of the lattice these are, all but stray ones.
    empty : number of other visible, empty cells.
    """

    grid: IntArray
    kept: BoolArray
    empty: int


def boards_meant(found: CircleGrid, boards: Sequence[Board]) -> list[tuple[Board, BoardDetection]]:
    """Return the boards that fit the lattice, the likeliest first, each with the circles on its grid, unnamed.

    They are those with the fewest visible places that are empty: if the image's border cuts off the corner of a board,
    the paper beside it is visible where a larger board would have circles. If the lattice is a whole board, that comes
    first, followed by larger boards of which it may be a part, in any place, cut off by the image's border.
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
    return [(board, _detection(found, place, board.size)) for board, place in likely]


def may_be_part(found: CircleGrid, board: Board) -> bool:
    """Return whether the lattice can be a part of the board, the rest being cut off by the image's border."""
    return _open_place(found, board, MAX_EMPTY_DIFFERENCE) is not None


def _open_place(found: CircleGrid, board: Board, max_empty: int) -> _Place | None:
    """Return a place on the board that leaves at most `max_empty` visible places empty; None if there is none."""
    fullest = min(_places_on(found, board), key=lambda place: place.empty, default=None)
    return None if fullest is None or fullest.empty > max_empty else fullest


def placed_on(found: CircleGrid, board: Board) -> BoardDetection | None:
    """Return the circles on the board's grid, unnamed, or None if their place is ambiguous."""
    place = _place_on(found, board)
    return None if place is None else _detection(found, place, board.size)


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
    return max(good, key=lambda place: _upright(place.grid, found.pixels[place.kept]))


def _places_on(found: CircleGrid, board: Board) -> list[_Place]:
    """Return all possible places of the lattice on the board."""
    pattern = board.pattern
    if not isinstance(pattern, Circles) or pattern.inverted != found.bright:
        return []
    return [place for circles, empty in _counted(found, pattern.layout) for place in _places(circles, empty, board)]


def lone_part(found: CircleGrid, board: Board) -> BoardDetection | None:
    """Return the circles on a grid of their own if they can be a part of the board, else None."""
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
    return _detection(found, _Place(best[1], np.ones(len(found), np.bool_), 0), (columns, rows))


def _counted(found: CircleGrid, layout: str) -> Iterator[tuple[IntArray, IntArray]]:
    """Yield circles and empty places as (column, row), or, if staggered, as (half column, row), in all rotations.

    They are right-handed like the labels, and do not begin at zero. A lattice of the other kind has none.
    """
    if found.hexagonal != (layout == "hexagonal"):
        return
    label, empty = found.label, found.empty
    for _ in range(6 if found.hexagonal else 4):
        if found.hexagonal:
            yield tuple(np.stack([2 * p + q, q], axis=-1) for p, q in (label.T, empty.T))  # type: ignore[misc]
            # Rotated by 60 degrees: a becomes b, b becomes b - a.
            label, empty = (np.stack([p + q, -p], axis=-1) for p, q in (label.T, empty.T))
        else:
            if layout == "asymmetric":
                yield tuple(np.stack([p - q, p + q], axis=-1) for p, q in (label.T, empty.T))  # type: ignore[misc]
            else:
                yield label, empty
            label, empty = (np.stack([-q, p], axis=-1) for p, q in (label.T, empty.T))


def _cells(circles: IntArray, pattern: Circles) -> IntArray:
    """Return (column, row) of circles given as (half column, row) from zero, or as (column, row) if regular."""
    if not pattern.staggered:
        return circles
    half, row = circles.T
    if ((half[0] + row[0]) % 2 == 0) != (pattern.stagger == "right"):
        half = half + 1
    return np.stack([half // 2, row], axis=-1)


def _places(circles: IntArray, empty: IntArray, board: Board) -> Iterator[_Place]:
    """Yield the possible places on the board of circles in one numbering."""
    pattern = board.pattern
    staggered = isinstance(pattern, Circles) and pattern.staggered
    columns, rows = board.size
    wide = 2 * columns if staggered else columns
    there = np.ones((rows, wide), bool)
    if staggered:
        row, half = np.indices(there.shape)
        there = (row + half) % 2 == int(isinstance(pattern, Circles) and pattern.stagger == "left")
    kept = _on_board(circles, empty, there)
    if kept is None:
        return
    circles = circles[kept]
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
            yield _Place(np.stack([at[:, 0] // 2 if staggered else at[:, 0], at[:, 1]], axis=-1), kept, left)


def _on_board(circles: IntArray, empty: IntArray, there: BoolArray) -> BoolArray | None:
    """Return which circles (N,) may be on a board with circles `there`: all but stray ones in lines that are too many,
    and None if more are too many."""
    kept = np.ones(len(circles), np.bool_)
    for axis, points in enumerate((there.sum(axis=0), there.sum(axis=1))):
        while kept.any() and np.ptp(places := circles[kept, axis]) >= len(points):
            ends = [int(places.min()), int(places.max())]
            counts = [int(np.count_nonzero(places == end)) for end in ends]
            line = ends[int(np.argmin(counts))]
            if min(counts) > STRAY_CIRCLES or (empty[:, axis] == line).sum() <= EMPTY_LINE * points.max():
                return None
            kept &= circles[:, axis] != line
    return kept if kept.any() else None


def _empty_line(at: IntArray, empty: IntArray, there: BoolArray) -> bool:
    """Return whether the line of the board before or after all circles `at` is visible and empty."""
    for axis, points in enumerate((there.sum(axis=0), there.sum(axis=1))):
        for line in (at[:, axis].min() - 1, at[:, axis].max() + 1):
            if 0 <= line < len(points) and (empty[:, axis] == line).sum() > EMPTY_LINE * points[line]:
                return True
    return False


def _key(grid: IntArray, board: Board) -> tuple[int, ...]:
    """Return a key, the occupied cells, that is the same for all places that look the same when the board is turned."""
    turned = (grid_turned(grid, board.size, turns) for turns in (0, *board.turns))
    return min(tuple(np.sort(cells @ [1, board.columns]).tolist()) for cells in turned)


def _upright(grid: IntArray, pixels: FloatArray) -> float:
    """Return how closely columns are directed to the right and rows downwards, at most 2."""
    centred = grid - grid.mean(axis=0)
    slope = np.linalg.lstsq(centred.astype(np.float64), pixels - pixels.mean(axis=0), rcond=None)[0]
    slope = slope / np.maximum(np.linalg.norm(slope, axis=1, keepdims=True), 1e-12)
    return float(slope[0, 0] + slope[1, 1])


def _detection(found: CircleGrid, place: _Place, size: tuple[int, int]) -> BoardDetection:
    order = np.lexsort(place.grid.T)
    pixels, sigma_px = found.pixels[place.kept], found.sigma_px[place.kept]
    return BoardDetection(None, *size, place.grid[order], pixels[order], sigma_px[order])
