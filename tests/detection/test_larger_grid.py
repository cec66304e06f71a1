"""Whole chessboards larger than the declared one for which a part of them passed."""

from __future__ import annotations

import numpy as np
from detection_bench.scenes import one_board

from rigkit.core.boards import Board
from rigkit.core.detections import BoardDetection
from rigkit.detection.detect import detect_boards
from rigkit.detection.larger_grid import larger_grid


def test_a_part_of_a_whole_larger_board_is_told(rng: np.random.Generator) -> None:
    board, declared = Board("b", 9, 6, 30.0, 30.0), Board("b", 6, 8, 30.0, 30.0)
    image = one_board(rng, board=board).render(noise_levels=2.0, rng=rng)
    (whole,) = detect_boards(image, [board])
    inside = whole.grid[:, 0] < 8
    grid = whole.grid[inside][:, ::-1]
    part = BoardDetection("b", 6, 8, grid, whole.pixels[inside], whole.sigma_px[inside])
    assert larger_grid(image, [part], [declared]) == "6 x 9 inner corners are seen, 6 x 8 are declared"
    assert larger_grid(image, [whole], [board]) is None
    assert larger_grid(image, [], [declared]) is None
    # What is next to it is another board.
    elsewhere = BoardDetection("b", 6, 8, grid, part.pixels + 2000.0, part.sigma_px)
    assert larger_grid(image, [elsewhere], [declared]) is None
