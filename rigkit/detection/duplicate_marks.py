"""Identical boards in one image, whose marks cannot be told from each other."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from rigkit.core.arrays import FloatArray, IntArray
from rigkit.core.boards import Board
from rigkit.core.patterns.aprilgrid import AprilGrid
from rigkit.core.patterns.charuco import Charuco
from rigkit.detection.saddles.mosaic import without_mosaic
from rigkit.detection.saddles.response import GreyImage, grey_image
from rigkit.detection.tags.codes import MIN_LIKENESS, Codes, read_tags
from rigkit.detection.tags.in_squares import marker_codes
from rigkit.detection.tags.markers import MIN_MARKER_LIKENESS
from rigkit.detection.tags.quads import quadrilaterals

DUPLICATES_REMEDY = "print one with other numbers (first_marker, first_tag), or show one at a time"
"""What to do about identical boards."""

MIN_DUPLICATES, MIN_SHARE_OF_DUPLICATES = 3, 0.05
"""Smallest number and share of marks at two places: some may be misread, of hundreds in REAL images up to three."""

MIN_SEPARATION_SIDES = 1.5
"""Smallest distance of two places of a mark, in its sides: one mark is found at its outer and its inner border."""


def duplicate_boards(image: NDArray[np.generic], boards: Sequence[Board]) -> str | None:
    """Return a message on the first of `boards` whose marks are at two places in an image, of which one is used; None
    if there is none."""
    grey = without_mosaic(grey_image(image))
    for board in boards:
        if board.identified and _have_duplicates(*_marks(grey, board)):
            return (
                f"the marks of '{board.board_id}' are seen twice: of boards alike in one image only one is found; "
                f"{DUPLICATES_REMEDY}"
            )
    return None


def _marks(grey: GreyImage, board: Board) -> tuple[FloatArray, IntArray]:
    """Return the corners (N, 4, 2) of the visible marks of a board, and their numbers (N,)."""
    pattern = board.pattern
    if isinstance(pattern, AprilGrid):
        codes, least = Codes.of(pattern, pattern.numbers(*board.size).ravel()), MIN_LIKENESS
    else:
        codes, least = marker_codes(board), MIN_MARKER_LIKENESS
    grey = 255 - grey if isinstance(pattern, Charuco | AprilGrid) and pattern.inverted else grey
    quads = quadrilaterals(grey)
    tags = read_tags(grey, quads, codes)
    seen = tags.likeness >= least
    return quads[seen], tags.number[seen]


def _have_duplicates(quads: FloatArray, numbers: IntArray) -> bool:
    """Return whether enough marks are at two places to be those of two boards."""
    middle, side = quads.mean(axis=1), np.linalg.norm(quads[:, 1] - quads[:, 0], axis=1)
    away = np.linalg.norm(middle[:, None] - middle, axis=2) > MIN_SEPARATION_SIDES * np.maximum(side[:, None], side)
    twins = len(np.unique(numbers[((numbers[:, None] == numbers) & away).any(axis=1)]))
    return twins >= max(MIN_DUPLICATES, MIN_SHARE_OF_DUPLICATES * len(np.unique(numbers)))
