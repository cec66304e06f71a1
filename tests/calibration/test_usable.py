"""A wrong size in the board file is told from boards that the frame cuts."""

from __future__ import annotations

import numpy as np

from rigkit.calibration.usable import other_size
from rigkit.core.boards import Board
from rigkit.core.detections import BoardDetection

STATED = (Board("stated", 9, 7, 30.0, 30.0),)


def grid(columns: int, rows: int, *, corners: int | None = None) -> BoardDetection:
    cells = np.stack(np.meshgrid(np.arange(columns), np.arange(rows)), axis=-1).reshape(-1, 2)
    # The outer corners stay, so that the size does.
    kept = np.r_[np.arange(columns * rows - 1)[:corners], columns * rows - 1]
    return BoardDetection(
        None, columns, rows, cells[kept], np.asarray(20.0 * cells[kept] + 50.0), np.full(len(kept), 0.05)
    )


def shown(*grids: BoardDetection) -> dict[str, list[BoardDetection]]:
    return {f"{k}.png": [one] for k, one in enumerate(grids)}


def test_whole_grids_of_another_size_are_other_boards() -> None:
    words = other_size(shown(grid(9, 6), grid(9, 6), grid(9, 6), grid(9, 6), grid(8, 5)), STATED)
    assert words == "9 x 6 inner corners are seen in 4 of 5 images, 9 x 7 are declared"


def test_a_larger_board_of_which_part_was_taken() -> None:
    declared = (Board("b", 8, 6, 30.0, 30.0),)
    mostly = shown(*[grid(9, 6)] * 7, *[grid(8, 6)] * 7)
    assert other_size(mostly, declared) == "9 x 6 inner corners are seen in 7 of 14 images, 8 x 6 are declared"
    assert other_size(shown(*[grid(9, 6)] * 3, *[grid(8, 6)] * 20), declared) is None
    # Another board beside the declared one is no reason to doubt that.
    assert other_size({f"{k}.png": [grid(8, 6), grid(9, 6)] for k in range(10)}, declared) is None


def test_parts_of_the_stated_board_are_not() -> None:
    assert other_size(shown(grid(9, 6), grid(8, 7), grid(9, 5), grid(7, 7), grid(9, 6)), STATED) is None
    assert other_size(shown(*[grid(9, 6)] * 4, grid(7, 9, corners=40)), STATED) is None
    assert other_size(shown(*[grid(9, 6)] * 2), STATED) is None
    assert other_size(shown(*[grid(9, 6, corners=50)] * 5), STATED) is None
    assert other_size({}, STATED) is None
