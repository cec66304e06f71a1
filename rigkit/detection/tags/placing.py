"""The place of lattices of corners on boards of tags, by a vote of the tags read in their squares."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from rigkit.core.arrays import FloatArray, IntArray
from rigkit.core.boards import Board
from rigkit.core.detections import grid_turned
from rigkit.core.patterns.aprilgrid import AprilGrid
from rigkit.detection.lattice.lattice import Lattice
from rigkit.detection.saddles.response import GreyImage
from rigkit.detection.tags.codes import Codes, excess_likeness, read_tags
from rigkit.kernels.tag_board import TagsOfBoard, squares_of_lattice, vote_place

MIN_BITS = 30
"""Smallest number of bits in all agreeing tags together: one tag of 36, two of 25 or 16."""

AGREEING_TAGS = 0.4
"""Smallest share of the squares with tags in a place on the board that are read as these tags: misread codes agree with
no others, and dirt and glare cover a few tags."""

AGREEING_READ = 0.7
"""Smallest share of the squares read as any tag in a place that are read as the tag there: codes of few bits are often
misread; in the mirror image of a board of nine tags of 16 bits eight are read and four agree (RENDERED). If blur causes
misreadings of a board's own tags, all tags are evaluated together."""

SURE_EXCESS = 6.0
"""Smallest excess correlation of all tags of a lattice together with their codes, in standard deviations of random
ones; the sum of many is normal: one in a billion, with hundreds of places to try."""

AHEAD = 2.0
"""Smallest difference of the excess to that of any other place."""

LIKE_BETTER_ROWS = 0.5
"""Smallest mean excess of a row of tags that agrees with a place, relative to the better half of the rows: on a ChArUco
board of the other pattern every second row has 0, on a board with other columns than declared all rows but one."""

MIN_TAGS_OF_PLACE = 4
"""Smallest number of tags that are evaluated together; fewer are read one by one."""


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class TagBoard:
    """A board of tags with the data for reading it and placing its corners (R, C).

    Attributes
    ----------
    numbers : (R / 2, C / 2) of its tags, with `codes`.
    firsts : (highest number + 1, 2) the (column, row) of the first corner of each tag.
    places : (R, C, 2) of its corners, in sides of a tag.
    steps : (R, C, 2, 2) distances to the corners above and below, right and left, within the tag or across the gap.
    signs : (R, C) +1 where brightness increases with the angle across the line along the row, else -1.
    packed : the same for kernels.
    """

    board: Board
    pattern: AprilGrid
    numbers: IntArray
    firsts: IntArray
    codes: Codes
    places: FloatArray
    steps: FloatArray
    signs: FloatArray
    packed: TagsOfBoard

    @staticmethod
    def of(board: Board) -> TagBoard:
        """Return the cached data of a board."""
        return _tag_board(board)


@lru_cache(maxsize=64)
def _tag_board(board: Board) -> TagBoard:
    pattern = board.pattern
    assert isinstance(pattern, AprilGrid)
    numbers, grid = pattern.numbers(*board.size), board.grid()
    firsts = np.zeros((int(numbers.max()) + 1, 2), np.int64)
    firsts[numbers.ravel()] = grid[(grid % 2 == 0).all(axis=1)]
    odd = (grid % 2).reshape(board.rows, board.columns, 2)
    inwards = np.array([pattern.spacing, 1.0])
    right, below = inwards[1 - odd[..., 0]], inwards[1 - odd[..., 1]]
    left, above = inwards[odd[..., 0]], inwards[odd[..., 1]]
    codes = Codes.of(pattern, numbers.ravel())
    places = pattern.positions(grid.astype(np.float64)).reshape(board.rows, board.columns, 2)
    steps = np.stack([np.stack([above, below], axis=-1), np.stack([right, left], axis=-1)], axis=2)
    signs = np.where(odd[..., 0] ^ odd[..., 1], 1.0, -1.0)
    return TagBoard(
        board=board,
        pattern=pattern,
        numbers=numbers,
        firsts=firsts,
        codes=codes,
        places=places,
        steps=steps,
        signs=signs,
        packed=TagsOfBoard.of(
            places=places.reshape(-1, 2),
            steps=steps.reshape(-1, 2, 2),
            signs=signs.ravel(),
            numbers=numbers.ravel(),
            patterns=codes.patterns,
            code_numbers=codes.numbers,
            code_turns=codes.turns,
            rows=board.rows,
            columns=board.columns,
            modules=codes.modules,
            joined=pattern.corner_squares,
            spacing=pattern.spacing,
            border=pattern.border / codes.modules,
        ),
    )


def placed_lattices(image: GreyImage, lattices: Sequence[Lattice], board: TagBoard) -> tuple[FloatArray, set[int]]:
    """Return the corners of `board` (R, C, 2), NaN where unknown, and the indices of the lattices that have them."""
    columns, rows = board.board.size
    pixels = np.full((rows, columns, 2), np.nan)
    found: list[tuple[int, int, IntArray, FloatArray]] = []
    for n, lattice in enumerate(lattices):
        place = _place(image, lattice, board)
        if place is not None:
            votes, turns, shift = place
            row, column = np.nonzero(lattice.known)
            cells = grid_turned(np.stack([column, row], axis=-1), lattice.size, turns) + shift
            found.append((votes, n, cells, lattice.pixels[row, column]))
    used = set()
    # In decreasing order of agreeing tags; two lattices of one board do not overlap.
    for _, n, cells, own in sorted(found, key=lambda item: -item[0]):
        column, row = cells.T
        inside = (column >= 0) & (row >= 0) & (column < columns) & (row < rows)
        column, row, own = column[inside], row[inside], own[inside]
        free = np.isnan(pixels[row, column, 0])
        if 2 * np.count_nonzero(free) <= len(free):
            continue
        pixels[row[free], column[free]] = own[free]
        used.add(n)
    return pixels, used


def _place_together(
    image: GreyImage, size: tuple[int, int], quads: FloatArray, cells: IntArray, board: TagBoard
) -> Place | None:
    """Return the place of a lattice of this size from all tags in its squares, `quads` (N, 4, 2) at `cells` (N, 2)."""
    if len(quads) < MIN_TAGS_OF_PLACE:
        return None
    codes_at = np.full((board.board.rows, board.board.columns), -1)
    codes_at[::2, ::2] = 4 * np.arange(board.numbers.size).reshape(board.numbers.shape)
    return place_together(excess_likeness(image, quads, board.codes), cells, size, codes_at)


Place = tuple[int, int, IntArray]
"""Number of tags that agree, and quarter turns and shift (2,) from a lattice to the board's grid."""


def _place(image: GreyImage, lattice: Lattice, board: TagBoard) -> Place | None:
    """Return the place of a lattice on the board; None if it is unknown."""
    quads, cells = squares_of(lattice, dark=True)
    tags = read_tags(image, quads, board.codes)
    sure = np.flatnonzero(tags.read)
    if not len(sure):
        return _place_together(image, lattice.size, quads, cells, board)
    votes, turn, shift = voted_place(lattice, cells[sure], tags.turns[sure], board.firsts[tags.number[sure]])
    bits = (board.codes.modules - 2 * board.pattern.border) ** 2
    columns, rows = lattice.size
    column, row = (grid_turned(cells, (columns - 1, rows - 1), turn) + shift).T
    tagged = (column | row) & 1 == 0
    own = tagged & (column >= 0) & (row >= 0)
    own &= (column < board.board.columns) & (row < board.board.rows)
    least = max(AGREEING_TAGS * np.count_nonzero(own), AGREEING_READ * np.count_nonzero(own & tags.read))
    # A lattice may extend over an adjacent board, most of whose tags are not read as this one's.
    least = max(least, 0.5 * np.count_nonzero(tagged & tags.read))
    if votes * bits < MIN_BITS or votes < least:
        return _place_together(image, lattice.size, quads, cells, board)
    return votes, turn, shift


def place_together(excess: FloatArray, cells: IntArray, size: tuple[int, int], codes_at: IntArray) -> Place | None:
    """Return the place of a lattice whose codes may be too blurred to be read one by one: the one with the largest
    correlation of all of them with the board's codes. None if it may be random, or if it is that of some rows only.

    Parameters
    ----------
    excess : (N, 4 T) correlation of its squares with all codes, as `excess_likeness`.
    cells : (N, 2) column and row of the squares.
    size : (columns, rows) of the lattice.
    codes_at : (R, C) the upright code in each square of the board, -1 for none.
    """
    marked = excess.any(axis=1)
    if np.count_nonzero(marked) < MIN_TAGS_OF_PLACE:
        return None
    cells, excess = cells[marked], excess[marked]
    tall, wide = codes_at.shape
    columns, rows = size
    found: list[tuple[FloatArray, IntArray, IntArray]] = []
    for turn in range(4):
        turned = grid_turned(cells, (columns - 1, rows - 1), turn)
        low, high = turned.min(axis=0), turned.max(axis=0)
        own_wide, own_tall = high - low + 1
        # Reversed, so that each square of the board adds to all shifts at once.
        column, row = (high - turned).T
        grid, there = np.zeros((excess.shape[1], own_tall, own_wide)), np.zeros((own_tall, own_wide), dtype=np.int64)
        grid[:, row, column], there[row, column] = excess.T, 1
        total = np.zeros((tall + own_tall - 1, wide + own_wide - 1))
        count = np.zeros(total.shape, dtype=np.int64)
        for r, c in np.argwhere(codes_at >= 0):
            part = slice(r, r + own_tall), slice(c, c + own_wide)
            # Rotated back by `turn`, the tag is upright.
            total[part] += grid[codes_at[r, c] + (-turn) % 4]
            count[part] += there
        score = np.where(count < MIN_TAGS_OF_PLACE, 0.0, total / np.sqrt(np.maximum(count, 1)))
        y, x = np.indices(total.shape)
        move = np.stack([np.full(total.size, turn), x.ravel() - high[0], y.ravel() - high[1]], axis=1)
        found.append((score.ravel(), count.ravel(), move))
    score, count, move = (np.concatenate(part) for part in zip(*found, strict=True))
    best = int(score.argmax())
    if score[best] < max(SURE_EXCESS, AHEAD + float(np.delete(score, best).max(initial=0.0))):
        return None
    turn, shift = int(move[best, 0]), move[best, 1:]
    column, row = (grid_turned(cells, (columns - 1, rows - 1), turn) + shift).T
    own = (column >= 0) & (row >= 0) & (column < wide) & (row < tall)
    own[own] = codes_at[row[own], column[own]] >= 0
    row, agreement = row[own], excess[own, codes_at[row[own], column[own]] + -turn % 4]
    there = np.bincount(row)
    means = np.sort((np.bincount(row, agreement) / np.maximum(there, 1))[there > 0])
    agreeing = means > LIKE_BETTER_ROWS * means[len(means) // 2 :].mean()
    return (int(count[best]), turn, shift) if agreeing.mean() >= AGREEING_READ else None


def squares_of(lattice: Lattice, *, dark: bool) -> tuple[FloatArray, IntArray]:
    """Return the dark or the bright squares of a lattice: corners (N, 4, 2) in the order of increasing angle from u to
    v, and the (column, row) of their first corners (N, 2)."""
    # Brightness decreases with the angle across the edge from a dark square's first corner along the row.
    return squares_of_lattice(lattice.pixels, dark == lattice.rising)


def voted_place(lattice: Lattice, cells: IntArray, turns: IntArray, places: IntArray) -> tuple[int, int, IntArray]:
    """Return the largest number of tags that agree, and on which quarter turns and shift (2,) to the board's grid.

    The tags are in the squares `cells` (N, 2) of the lattice, rotated by `turns` (N,) quarter turns relative to it, and
    have the `places` (N, 2) on the board.
    """
    return vote_place(cells, turns, places, lattice.size)
