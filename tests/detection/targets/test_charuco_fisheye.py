"""Sigmas of large ChArUco boards through a fisheye: its bend is no scatter of the corners."""

from __future__ import annotations

import numpy as np
from detection_bench.scenes import one_board
from helpers.detection_scenes import errors_by_place

from rigkit.core.boards import Board
from rigkit.core.patterns.charuco import Charuco
from rigkit.detection.detect import detect_boards

BOARD = Board("c", 9, 6, 30.0, 30.0, pattern=Charuco("DICT_5X5_100", 21.0))


def test_the_bend_of_a_fisheye_is_no_scatter(rng: np.random.Generator) -> None:
    scene = one_board(rng, lens="fisheye", size_px=(1200, 900), board=BOARD, square_px=90.0)
    (found,) = detect_boards(scene.render(supersample=2, noise_levels=2.0, rng=rng), [BOARD])
    errors = errors_by_place(found, scene.truth()[0]) / found.sigma_px[:, None]
    assert 0.7 < np.sqrt((errors**2).mean()) < 1.4
