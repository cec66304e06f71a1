"""What a ChArUco board is beyond the markers that were read: of the pattern of today or the one before, and with rows
whose markers blur or the frame hides. The corners of the board say where its markers must be."""

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
"""Images that are asked which of two patterns a board has, where the places of its markers do not tell."""

SURE_OF_PATTERN = 3.0
"""They tell where this many standard deviations speak for one of the two."""

IMAGES_OF_ROWS = 4
"""Images that are asked whether a board has more rows than were read."""

LIKE_LAST = 0.4
"""The places beyond the last row that was read are like markers by so much of what that row is like its own, two
standard deviations more or less, or nothing is told. REAL boards, as they are, blurred by up to 4 px or with squares
that run over: 0.6 to 1.0 where there is one more row, -0.4 to 0.2 where there is none."""

PERCENT_INK_PAPER = (10.0, 90.0)
"""Percentiles of the brightness of the modules of markers: at least a fifth of them are paper, more than half ink."""

LIKE_PAPER, MAX_UNEVEN, AS_UNEVEN = 0.7, 0.2, 0.5
"""Bare paper is brighter than this, 0 for the ink and 1 for the paper of the markers beside it, and scatters by less
than this part of their scatter. Beyond the last rows of 3 boards in 26 REAL images: 0.8 to 1.7; below 0.15, but for
squares in which a shadow, a fold or the end of the paper lies, 0.15 to 0.36; markers 0.95 and more. What is too uneven
is asked how like markers it is; where some is half as uneven as markers, paper beside it may be a cover."""


def of_pattern(boards: Sequence[Board], images: Sequence[GreyImage]) -> tuple[Board, bool]:
    """Return the board of the pattern of today or of the one before it, and whether the images tell which.

    Where a row has an odd number of squares, the two are numbered alike but for one marker in every second row, which
    has its place at one end or at the other: there that marker is like what is seen, or it is not.
    """
    # With an even number of rows of corners both are one board.
    if len({_squares_of(board).tobytes() for board in boards}) == 1:
        return boards[0], True
    some = images[:: -(-len(images) // IMAGES_OF_PATTERN)]
    excess, places = np.sum(list(in_threads(lambda image: _for_the_second(boards, image), some)), axis=0)
    return boards[int(excess > 0.0)], bool(abs(excess) >= SURE_OF_PATTERN * np.sqrt(max(places, 1.0)))


def next_row(board: Board, images: Sequence[GreyImage]) -> bool | None:
    """Say whether images show one more row of squares than a board has; None where they do not tell: none shows its
    place, or its markers could not be recognised."""
    pattern = board.pattern
    assert isinstance(pattern, Charuco)
    # Two more, so that its first square has the same colour.
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
        # What is even may also be a cover, or outside of the picture that a corrected image holds.
        likeness[likeness == 0.0] = np.nan
        likeness[~last & _blank(bright, squares[:, 0], last & np.isfinite(likeness))] = 0.0
        return likeness

    likeness = np.array(list(in_threads(like, images[:: -(-len(images) // IMAGES_OF_ROWS)])))
    of_last, beyond = (likeness[:, row] for row in (last, ~last))
    return _like_the_last(beyond[np.isfinite(beyond)], of_last[np.isfinite(of_last)])


def _blank(bright: FloatArray, columns: IntArray, marked: BoolArray) -> BoolArray:
    """Say which squares, by the brightness (N, K) of their modules, are bare paper beside those with markers; none
    where others are as uneven as markers: the edge of a cover may cross these.

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
    """Say whether squares beyond a row are like their markers as those of the row itself are; None: not told.

    Blank paper, of likeness 0, speaks against them, but not where other squares beyond rather are like their markers:
    something white covers it there.
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
    """Return by how much more the markers that two boards have in different places are like what is seen where the
    second has them, in standard deviations of one, and at how many places."""
    found = next((item for item in detect_boards(image, boards[:1]) if item.board_id is not None), None)
    pattern = boards[0].pattern
    if found is None or not isinstance(pattern, Charuco):
        return 0.0, 0
    # Where both have them in this board's grid: the second's may be moved by a column.
    own, others = (_squares_of(board) for board in boards)
    steps, counts = np.unique(own - others, axis=0, return_counts=True)
    others = others + steps[counts.argmax()]
    differing = np.flatnonzero((own != others).any(axis=1))
    likenesses = [
        np.nan_to_num(likeness_at(image, found.lattice(), at[differing], pattern.first_marker + differing, boards[0]))
        for at in (own, others)
    ]
    return float(likenesses[1].sum() - likenesses[0].sum()), sum(int(np.count_nonzero(way)) for way in likenesses)
