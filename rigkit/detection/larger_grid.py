"""Whole chessboards of which a part was detected as a smaller declared one."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from rigkit.core.boards import Board
from rigkit.core.detections import BoardDetection
from rigkit.core.patterns.chessboard import Chessboard
from rigkit.detection.detect import detect_boards
from rigkit.detection.new_corners import SAME_PX
from rigkit.kernels.front import near_any


def larger_grid(image: NDArray[np.generic], found: Sequence[BoardDetection], boards: Sequence[Board]) -> str | None:
    """Return in words which whole larger grid most corners of a chessboard `found` as one of `boards` belong to; None
    if there is none. The image is searched once more, for chessboards of any size."""
    plain = {board.board_id: board for board in boards if isinstance(board.pattern, Chessboard)}
    parts = [one for one in found if one.board_id in plain]
    if not parts:
        return None
    for grid in detect_boards(image):
        for part in parts:
            same = int(near_any(part.pixels, grid.pixels, SAME_PX).sum())
            if grid.complete and len(grid.grid) > part.columns * part.rows and 2 * same > len(part.grid):
                across, down = sorted((grid.columns, grid.rows), reverse=part.columns >= part.rows)
                return f"{across} x {down} inner corners are seen, {part.columns} x {part.rows} are declared"
    return None
