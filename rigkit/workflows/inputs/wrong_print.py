"""Declared prints that the images contradict, though corners are found: the border of tags, the size of markers."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from rigkit.core.arrays import FloatArray
from rigkit.core.boards import Board
from rigkit.core.detections import BoardView
from rigkit.core.errors import InputError
from rigkit.core.findings import Finding
from rigkit.core.patterns.aprilgrid import MAX_BORDER, AprilGrid
from rigkit.core.patterns.charuco import Charuco
from rigkit.detection.saddles.response import GreyImage, grey_image
from rigkit.detection.tags.printed import likeness_to_print
from rigkit.io.media.images import read_image

IMAGES_OF_PRINT = 4
"""Images checked, spread over the session."""

BETTER_BORDER = 0.03
"""Smallest gain of the mean correlation of tags with their codes by another border. The right border gains 0.07 to 0.34
in an image (REAL, 2 sets, original, blurred by 2 px, with twice the light), so that the wrong one gains -0.07."""

MARKER_SIDES = np.arange(0.3, 0.96, 0.01)
"""Sides of markers that are tried, in squares."""

OFF_MARKER = 0.08
"""Difference of a marker's side from the declared one, in squares, from which it is reported: twice the largest one on
4 boards declared as printed (REAL, original, blurred by 2 px, with twice the light)."""


def wrong_print(views: Sequence[BoardView], images: Mapping[str, Path]) -> list[Finding]:
    """Return findings on boards whose tags or markers are printed otherwise than declared; unreadable `images` (files
    by name) are skipped."""
    out = []
    for board in {view.board.board_id: view.board for view in views}.values():
        prints = list(_prints(board))
        if prints:
            seen = list(_seen([view for view in views if view.board.board_id == board.board_id], images))
            likeness = [_mean_likeness(seen, one) for one in prints]
            out += _finding(board, prints[int(np.argmax(likeness))], max(likeness) - _mean_likeness(seen, board))
    return out


def _prints(board: Board) -> Iterator[Board]:
    pattern = board.pattern
    if isinstance(pattern, AprilGrid):
        for border in range(1, MAX_BORDER + 1):
            yield replace(board, pattern=replace(pattern, border=border))
    elif isinstance(pattern, Charuco):
        for side in MARKER_SIDES.tolist():
            yield replace(board, pattern=replace(pattern, marker_mm=side * min(board.squares_mm)))


def _seen(views: Sequence[BoardView], images: Mapping[str, Path]) -> Iterator[tuple[GreyImage, FloatArray]]:
    """Yield some images of a board's views with its corners (R, C, 2)."""
    there = [view for view in views if view.image in images]
    chosen = np.unique(np.linspace(0, len(there) - 1, min(IMAGES_OF_PRINT, len(there))).astype(int)).tolist()
    for view in (there[k] for k in chosen):
        lattice = np.full((view.board.rows, view.board.columns, 2), np.nan)
        lattice[view.grid[:, 1], view.grid[:, 0]] = view.pixels
        try:
            yield grey_image(read_image(images[view.image])), lattice
        except InputError:
            # Corners are kept beside the session: the image itself may have gone bad since.
            continue


def _mean_likeness(seen: Sequence[tuple[GreyImage, FloatArray]], board: Board) -> float:
    likeness = [likeness_to_print(image, lattice, board) for image, lattice in seen]
    marks = sum(map(len, likeness))
    return float(np.concatenate(likeness).mean()) if marks else 0.0


def _finding(declared: Board, seen: Board, gain: float) -> list[Finding]:
    own, other = declared.pattern, seen.pattern
    if isinstance(own, AprilGrid) and isinstance(other, AprilGrid) and gain > BETTER_BORDER:
        return [
            Finding.look(
                f"the tags of board '{declared.board_id}' have a border of {other.border} in the images, {own.border} "
                "is declared",
                f"set border = {other.border}",
            )
        ]
    if isinstance(own, Charuco) and isinstance(other, Charuco) and gain > 0.0:
        square = min(declared.squares_mm)
        if abs(other.marker_mm - own.marker_mm) > OFF_MARKER * square:
            return [
                Finding.look(
                    f"the markers of board '{declared.board_id}' have {other.marker_mm / square:.2f} of a square's "
                    f"side in the images, {own.marker_mm / square:.2f} is declared",
                    "measure a marker's black outline and correct marker_mm",
                )
            ]
    return []
