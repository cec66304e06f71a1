"""ChArUco boards declared as others, and others as ChArUco boards: no corner is named."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from detection_bench.scenes import one_board
from helpers.detection_scenes import errors_by_place

from rigkit.core.boards import Board
from rigkit.core.patterns.charuco import Charuco
from rigkit.detection.detect import detect_boards

BOARD = Board("c", 9, 6, 30.0, 30.0, pattern=Charuco("DICT_5X5_100", 21.0))


@pytest.mark.parametrize("declared", [Charuco("DICT_5X5_100", 21.0, legacy=True), Charuco("DICT_6X6_100", 21.0)])
def test_squares_of_another_board_name_none(declared: Charuco, rng: np.random.Generator) -> None:
    board = replace(BOARD, rows=5)
    image = one_board(rng, board=board, max_tilt_deg=20.0).render(supersample=2, noise_levels=2.0, rng=rng)
    assert not any(item.board_id for item in detect_boards(image, [replace(board, pattern=declared)]))


@pytest.mark.parametrize("columns", [7, 10, 11])
def test_markers_of_a_board_with_other_columns_name_none(columns: int) -> None:
    """The rows of markers agree one by one, each shifted further: up to 35 corners had wrong places."""
    rng = np.random.default_rng(1)
    board = replace(BOARD, pattern=Charuco("DICT_5X5_250", 21.0))
    image = one_board(rng, board=board, square_px=24.0, max_tilt_deg=20.0).render(
        supersample=2, noise_levels=2.0, rng=rng
    )
    assert not any(item.board_id for item in detect_boards(image, [replace(board, columns=columns)]))


def test_declared_as_a_chessboard_it_is_read_as_one(rng: np.random.Generator) -> None:
    scene = one_board(rng, board=BOARD)
    image = scene.render(supersample=2, noise_levels=2.0, rng=rng)
    (found,) = detect_boards(image, [Board("plain", 9, 6, 30.0, 30.0)])
    assert (found.board_id, found.complete) == ("plain", True)
    truth = scene.truth()[0]
    off = [np.abs(errors_by_place(found, t)).max() for t in (truth, truth.turned(2))]
    assert min(off) < 0.2


def test_a_chessboard_is_no_charuco_board(rng: np.random.Generator) -> None:
    scene = one_board(rng, board=Board("plain", 9, 6, 30.0, 30.0))
    (found,) = detect_boards(scene.render(supersample=2, noise_levels=2.0, rng=rng), [BOARD])
    assert found.board_id is None
