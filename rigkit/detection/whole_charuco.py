"""The pattern (today's or the former one) and the number of rows of a ChArUco board that the markers that were read
leave open. The corners of the board determine the places of all its markers, also of blurred or hidden ones."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from rigkit.core.arrays import BoolArray, FloatArray, IntArray, sampling_step
from rigkit.core.boards import Board
from rigkit.core.patterns.aruco import largest_dictionary, marker_count
from rigkit.core.patterns.charuco import Charuco
from rigkit.core.processes import in_threads
from rigkit.detection.detect import detect_boards
from rigkit.detection.saddles.response import GreyImage
from rigkit.detection.tags.in_squares import brightness_around, brightness_at, likeness_at

IMAGES_OF_PATTERN = 8
"""Number of images from which the pattern is determined."""

SURE_OF_PATTERN = 3.0
"""Smallest difference of both patterns, in standard deviations, that determines the pattern."""

IMAGES_OF_ROWS = 4
"""Number of images in which the next row is searched for."""

LIKE_LAST = 0.4
"""Limit of the likeness of the places beyond the last row read to markers, relative to that row's, undecided within two
standard deviations. REAL boards, original, blurred by up to 4 px or with squares that spread: 0.6 to 1.0 if there is
one more row, -0.4 to 0.2 if there is none."""

PERCENT_INK_PAPER = (10.0, 90.0)
"""Percentiles of the brightness of the modules of markers: at least a fifth of them are paper, more than half ink."""

ACROSS_SQUARE, BEFORE_END, BEYOND_END = (0.2, 0.5, 0.8), 0.92, 1.06
"""Positions in squares of the last row, in their sides, at which the brightness shows where they end. The black squares
of 5 boards in 46 REAL images, original and blurred by 3 px, end at 0.94 to 1.03 as predicted from the corners; at 1.07
begins what is around a board that is cut out along its squares."""

MIN_ENDS = 2
"""Smallest number of squares that show where a board begins: one alone may be hidden."""

MARKER_SEEN = 0.5
"""Smallest likeness of a marker that is not hidden, relative to the median of the row."""


def choose_pattern(boards: Sequence[Board], images: Sequence[GreyImage]) -> tuple[Board, bool]:
    """Return the board with today's or the former pattern, and whether the images determine which.

    If a row has an odd number of squares, only one marker in every second row differs: it is at one end of the row or
    at the other, where its likeness decides.
    """
    # With an even number of rows of corners both patterns are the same board.
    if len({_squares_of(board).tobytes() for board in boards}) == 1:
        return boards[0], True
    some = images[:: sampling_step(len(images), IMAGES_OF_PATTERN)]
    excess, places = np.sum(list(in_threads(lambda image: _evidence_for_second(boards, image), some)), axis=0)
    return boards[int(excess > 0.0)], bool(abs(excess) >= SURE_OF_PATTERN * np.sqrt(max(places, 1.0)))


def has_next_row(board: Board, images: Sequence[GreyImage]) -> bool | None:
    """Return whether images show one more row of squares than a board has; None if they do not determine it, because
    its place is not visible, or its markers could not be recognised."""
    pattern = board.pattern
    assert isinstance(pattern, Charuco)
    # Two rows more, so that its first square has the same colour.
    dictionary = largest_dictionary(pattern.dictionary)
    taller = replace(board, rows=board.rows + 2, pattern=replace(pattern, dictionary=dictionary))
    squares = pattern.places(*taller.size)
    numbers = pattern.first_marker + np.arange(len(squares))
    if numbers[-1] >= marker_count(dictionary):
        return False
    asked = (squares[:, 1] == board.rows) | (squares[:, 1] == board.rows + 1)
    squares, numbers = squares[asked], numbers[asked]
    last = squares[:, 1] == board.rows

    def like(image: GreyImage) -> tuple[FloatArray, int]:
        found = next((item for item in detect_boards(image, [taller]) if item.board_id is not None), None)
        if found is None:
            return np.full(len(squares), np.nan), 0
        pixels = found.lattice()[: board.rows + 1]
        likeness = likeness_at(image, pixels, squares, numbers, taller)
        # An even place may also be covered, or outside of the valid part of a corrected image.
        likeness[likeness == 0.0] = np.nan
        return likeness, _ends(image, pixels, squares[last & _visible(likeness, last)], taller)

    likeness, ends = zip(*in_threads(like, images[:: sampling_step(len(images), IMAGES_OF_ROWS)]), strict=True)
    of_last, beyond = (np.concatenate([one[row] for one in likeness]) for row in (last, ~last))
    return _resembles_last_row(beyond[np.isfinite(beyond)], of_last[np.isfinite(of_last)], sum(ends))


def has_first_row(board: Board, images: Sequence[GreyImage]) -> bool:
    """Return whether no row is before a board's first one: its markers are numbered from 0, or images show it."""
    pattern = board.pattern
    assert isinstance(pattern, Charuco)
    if pattern.first_marker == 0:
        return True
    squares = pattern.places(*board.size)
    first = squares[:, 1] == 0
    numbers = pattern.first_marker + np.flatnonzero(first)

    def count(image: GreyImage) -> int:
        found = next((item for item in detect_boards(image, [board]) if item.board_id is not None), None)
        if found is None:
            return 0
        likeness = likeness_at(image, found.lattice(), squares[first], numbers, board)
        visible = _visible(likeness, np.ones(len(likeness), np.bool_))
        return _ends(image, found.lattice(), squares[first][visible], board, first=True)

    return sum(in_threads(count, images[:: sampling_step(len(images), IMAGES_OF_ROWS)])) >= MIN_ENDS


def _visible(likeness: FloatArray, row: BoolArray) -> BoolArray:
    """Return which markers (N,) are visible, by the median likeness of those of a row."""
    return np.asarray(likeness > MARKER_SEEN * np.median([*likeness[row & np.isfinite(likeness)], 0.0]))


def _ends(image: GreyImage, pixels: FloatArray, marked: IntArray, board: Board, *, first: bool = False) -> int:
    """Return how many squares with markers, `marked` (M, 2), of the last row show that the board ends with it: the next
    row would have black squares beyond them. It is 0 if one shows that it does not, or that the last row is covered:
    then the black squares beside end elsewhere than it does. Or likewise the `first` row, before which it begins.

    pixels : (R, C, 2) corners.
    """
    columns = pixels.shape[1] + 1
    if not len(marked):
        return 0
    row = np.stack([np.arange(columns), np.full(columns, marked[0, 1])], axis=1)
    across, down = np.meshgrid(ACROSS_SQUARE, (BEFORE_END, BEYOND_END))
    at = np.stack([across.ravel(), 1.0 - down.ravel() if first else down.ravel()], axis=1)
    levels = brightness_around(image, pixels, row, at, board).reshape(columns, *across.shape).mean(axis=2)
    count = 0
    for column, modules in zip(marked[:, 0].tolist(), brightness_at(image, pixels, marked, board), strict=True):
        bright = levels > 0.5 * np.percentile(modules, PERCENT_INK_PAPER).sum()
        seen = np.isfinite(levels)
        beside = [k for k in (column - 1, column + 1) if 0 <= k < columns and seen[k].all()]
        if (seen & ~bright)[column, 1] or any(tuple(bright[k]) != (False, True) for k in beside):
            return 0
        count += bool(beside) and bool(seen[column, 1])
    return count


def _resembles_last_row(beyond: FloatArray, last: FloatArray, ends: int) -> bool | None:
    """Return whether squares beyond a row resemble their markers as much as those of the row itself; None if unknown.

    Paper beyond squares, `ends` of them, is evidence against markers, unless other squares beyond the row resemble
    theirs: then something white covers it. Without any, something else may cover it.
    """
    if not len(last) or len(beyond) + ends == 0:
        return None
    least = LIKE_LAST * float(last.mean())
    if not len(beyond) or beyond.mean() <= least:
        beyond = np.append(beyond, np.zeros(ends))
    excess, two_sigmas = float(beyond.mean()) - least, 2.0 / np.sqrt(len(beyond))
    if abs(excess) < two_sigmas:
        return None
    return True if excess > 0.0 else False if ends else None


def _squares_of(board: Board) -> IntArray:
    """Return column and row of the square of every marker (M, 2)."""
    assert isinstance(board.pattern, Charuco)
    return board.pattern.places(*board.size)


def _evidence_for_second(boards: Sequence[Board], image: GreyImage) -> tuple[float, int]:
    """Return by how much the likeness of the markers at different places on two boards is larger for the second, in
    standard deviations of one marker, and the number of places."""
    found = next((item for item in detect_boards(image, boards[:1]) if item.board_id is not None), None)
    pattern = boards[0].pattern
    if found is None or not isinstance(pattern, Charuco):
        return 0.0, 0
    # The places of both on this board's grid: those of the second may be shifted by a column.
    own, others = (_squares_of(board) for board in boards)
    steps, counts = np.unique(own - others, axis=0, return_counts=True)
    others = others + steps[counts.argmax()]
    differing = np.flatnonzero((own != others).any(axis=1))
    likenesses = [
        np.nan_to_num(likeness_at(image, found.lattice(), at[differing], pattern.first_marker + differing, boards[0]))
        for at in (own, others)
    ]
    return float(likenesses[1].sum() - likenesses[0].sum()), sum(int(np.count_nonzero(way)) for way in likenesses)
