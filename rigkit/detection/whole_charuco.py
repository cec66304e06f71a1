"""What a ChArUco board is beyond the markers that were read: of the pattern of today or the one before, and with rows
whose markers blur or the frame hides. The corners of the board say where its markers must be."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from rigkit.core.arrays import FloatArray
from rigkit.core.boards import Board
from rigkit.core.patterns.aruco import largest_dictionary, marker_count
from rigkit.core.patterns.charuco import Charuco
from rigkit.core.processes import in_threads
from rigkit.detection.detect import detect_boards
from rigkit.detection.saddles.response import GreyImage
from rigkit.detection.tags.in_squares import likeness_at

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


def of_pattern(boards: Sequence[Board], images: Sequence[GreyImage]) -> tuple[Board, bool]:
    """Return the board of the pattern of today or of the one before it, and whether the images tell which.

    Where a row has an odd number of squares, the two are numbered alike but for one marker in every second row, which
    has its place at one end or at the other: there that marker is like what is seen, or it is not.
    """
    if len(boards) == 1:
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

    def like(image: GreyImage) -> FloatArray:
        found = next((item for item in detect_boards(image, [taller]) if item.board_id is not None), None)
        if found is None:
            return np.zeros(len(squares))
        return likeness_at(image, found.lattice()[: board.rows + 1], squares, numbers, taller)

    likeness = np.array(list(in_threads(like, images[:: -(-len(images) // IMAGES_OF_ROWS)])))
    last, beyond = (likeness[:, squares[:, 1] == row] for row in (board.rows, board.rows + 1))
    # What is not in view is like nothing.
    last, beyond = last[last != 0.0], beyond[beyond != 0.0]
    if not len(last) or not len(beyond):
        return None
    excess, two_sigmas = float(beyond.mean() - LIKE_LAST * last.mean()), 2.0 / np.sqrt(len(beyond))
    return None if abs(excess) < two_sigmas else excess > 0.0


def _for_the_second(boards: Sequence[Board], image: GreyImage) -> tuple[float, int]:
    """Return by how much more the markers that two boards have in different places are like what is seen where the
    second has them, in standard deviations of one, and at how many places."""
    found = next((item for item in detect_boards(image, boards[:1]) if item.board_id is not None), None)
    pattern = boards[0].pattern
    if found is None or not isinstance(pattern, Charuco):
        return 0.0, 0
    # Where both have them in this board's grid: the second's may be moved by a column.
    own, others = (board.pattern.places(*board.size) for board in boards if isinstance(board.pattern, Charuco))
    steps, counts = np.unique(own - others, axis=0, return_counts=True)
    others = others + steps[counts.argmax()]
    apart = np.flatnonzero((own != others).any(axis=1))
    ways = [
        likeness_at(image, found.lattice(), at[apart], pattern.first_marker + apart, boards[0]) for at in (own, others)
    ]
    return float(ways[1].sum() - ways[0].sum()), sum(int(np.count_nonzero(way)) for way in ways)
