"""The pattern (today's or the former one) and the number of rows of a ChArUco board that the markers that were read
leave open. The corners of the board determine the places of all its markers, also of blurred or hidden ones."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from rigkit.core.arrays import BoolArray, FloatArray, IntArray
from rigkit.core.boards import Board
from rigkit.core.patterns.aruco import largest_dictionary, marker_count
from rigkit.core.patterns.charuco import Charuco
from rigkit.core.processes import in_threads
from rigkit.detection.detect import detect_boards
from rigkit.detection.saddles.response import GreyImage
from rigkit.detection.tags.in_squares import brightness_at, likeness_at

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

LIKE_PAPER, MAX_UNEVEN, AS_UNEVEN = 0.7, 0.2, 0.5
"""Bare paper is brighter than LIKE_PAPER, 0 for the ink and 1 for the paper of adjacent markers, and scatters by less
than MAX_UNEVEN of their scatter. Beyond the last rows of 3 boards in 26 REAL images: 0.8 to 1.7; below 0.15, except for
squares with a shadow, a fold or the end of the paper, 0.15 to 0.36; markers 0.95 and more. Less even squares are
compared with markers; if one scatters by more than AS_UNEVEN, the paper beside it may be a cover."""


def of_pattern(boards: Sequence[Board], images: Sequence[GreyImage]) -> tuple[Board, bool]:
    """Return the board with today's or the former pattern, and whether the images determine which.

    If a row has an odd number of squares, only one marker in every second row differs: it is at one end of the row or
    at the other, where its likeness decides.
    """
    # With an even number of rows of corners both patterns are the same board.
    if len({_squares_of(board).tobytes() for board in boards}) == 1:
        return boards[0], True
    some = images[:: -(-len(images) // IMAGES_OF_PATTERN)]
    excess, places = np.sum(list(in_threads(lambda image: _for_the_second(boards, image), some)), axis=0)
    return boards[int(excess > 0.0)], bool(abs(excess) >= SURE_OF_PATTERN * np.sqrt(max(places, 1.0)))


def next_row(board: Board, images: Sequence[GreyImage]) -> bool | None:
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

    def like(image: GreyImage) -> FloatArray:
        found = next((item for item in detect_boards(image, [taller]) if item.board_id is not None), None)
        if found is None:
            return np.full(len(squares), np.nan)
        pixels = found.lattice()[: board.rows + 1]
        likeness = likeness_at(image, pixels, squares, numbers, taller)
        bright = brightness_at(image, pixels, squares, taller)
        # An even place may also be covered, or outside of the valid part of a corrected image.
        likeness[likeness == 0.0] = np.nan
        likeness[~last & _blank(bright, squares[:, 0], last & np.isfinite(likeness))] = 0.0
        return likeness

    likeness = np.array(list(in_threads(like, images[:: -(-len(images) // IMAGES_OF_ROWS)])))
    of_last, beyond = (likeness[:, row] for row in (last, ~last))
    return _like_the_last(beyond[np.isfinite(beyond)], of_last[np.isfinite(of_last)])


def _blank(bright: FloatArray, columns: IntArray, marked: BoolArray) -> BoolArray:
    """Return which squares (N,) are bare paper beside those with markers, from the brightness (N, K) of their modules;
    none if others are about as uneven as markers, as the edge of a cover may cross them.

    columns : (N,) of the squares.
    marked : (N,) those that have markers, in one row.
    """
    marked = marked & np.isfinite(bright).all(axis=1)
    blank = np.zeros(len(bright), np.bool_)
    for k in np.flatnonzero(np.isfinite(bright).all(axis=1) & ~marked):
        beside = bright[marked & (np.abs(columns - columns[k]) == 1)]
        if len(beside):
            ink, paper = np.percentile(beside, PERCENT_INK_PAPER)
            contrast = max(paper - ink, 1e-3)
            uneven = float(bright[k].std()) / max(float(beside.std(axis=1).mean()), 1e-3)
            if uneven > AS_UNEVEN:
                return np.zeros(len(bright), np.bool_)
            blank[k] = uneven < MAX_UNEVEN and float(bright[k].mean()) - ink > LIKE_PAPER * contrast
    return blank


def _like_the_last(beyond: FloatArray, last: FloatArray) -> bool | None:
    """Return whether squares beyond a row resemble their markers as much as those of the row itself; None if unknown.

    Blank paper, with likeness 0, is evidence against markers, unless other squares beyond the row resemble theirs: then
    something white covers it.
    """
    if not len(last) or not len(beyond):
        return None
    least = LIKE_LAST * float(last.mean())
    marked = beyond[beyond != 0.0]
    if len(marked) and marked.mean() > least:
        beyond = marked
    excess, two_sigmas = float(beyond.mean()) - least, 2.0 / np.sqrt(len(beyond))
    return None if abs(excess) < two_sigmas else excess > 0.0


def _squares_of(board: Board) -> IntArray:
    """Return column and row of the square of every marker (M, 2)."""
    assert isinstance(board.pattern, Charuco)
    return board.pattern.places(*board.size)


def _for_the_second(boards: Sequence[Board], image: GreyImage) -> tuple[float, int]:
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
