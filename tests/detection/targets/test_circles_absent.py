"""Pictures without grids of circles, or of other sizes than declared: nothing is found."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
from detection_bench.blanks import BLANKS, blank
from detection_bench.scenes import one_board
from detectors.degradations import degraded

from rigkit.core.boards import Board
from rigkit.core.patterns.circles import Circles
from rigkit.detection.circles.search import CircleSearch, find_grids
from rigkit.detection.detect import detect_boards
from rigkit.detection.saddles.response import grey_image

REGULAR = Board("r", 10, 8, 25.0, 25.0, pattern=Circles(diameter_mm=15.0))


def test_a_grid_of_another_size_is_no_board() -> None:
    rng = np.random.default_rng(0)
    scene = one_board(rng, lens="regular", board=REGULAR)
    image = scene.render(noise_levels=2.0, rng=rng)
    smaller = replace(REGULAR, board_id="s", columns=9, rows=7)
    assert detect_boards(image, [smaller]) == ()
    larger = replace(REGULAR, board_id="m", columns=11, rows=8)
    assert all(found.board_id is None for found in detect_boards(image, [larger]))
    assert detect_boards(image, [replace(REGULAR, pattern=Circles(diameter_mm=15.0, inverted=True))]) == ()


def test_two_circles_of_a_covered_column_tell_a_larger_board() -> None:
    scene = one_board(np.random.default_rng(0), lens="regular", board=REGULAR)
    image = scene.render(noise_levels=2.0, rng=np.random.default_rng(0)).astype(np.uint8)
    (truth,) = scene.truth()
    last = truth.lattice()[2:, -2:]
    for before, place in last:
        radius = round(0.45 * float(np.hypot(*(place - before))))
        cv2.circle(image, tuple(np.rint(place).astype(int).tolist()), radius, 200, -1)
    assert detect_boards(image, [replace(REGULAR, board_id="s", columns=9)]) == ()
    (found,) = detect_boards(image, [REGULAR])
    assert found.board_id == "r" and len(found.grid) == REGULAR.corner_count - len(last)


@pytest.mark.filterwarnings("error::RuntimeWarning")
@pytest.mark.parametrize("name", sorted(set(BLANKS) - {"dots", "staggered"}))
def test_nothing_is_found_where_no_circles_are(name: str) -> None:
    for seed in range(3):
        assert find_grids(blank(name, np.random.default_rng(seed))) == []


def test_octagons_out_of_focus_are_no_circles() -> None:
    octagons = cv2.GaussianBlur(blank("panels", np.random.default_rng(7048), (480, 360)), (0, 0), 2.0)
    assert find_grids(octagons.astype(np.uint8)) == []


def test_octagons_are_no_circles() -> None:
    """Without the eighth harmonic of their edges 23 of these were a grid."""
    octagons = blank("panels", np.random.default_rng(611), (640, 480))
    assert find_grids(octagons) == []
    assert max(grid.evidence.corners for grid in CircleSearch(octagons).seen() if len(grid) > 15) > 0.075


def test_cloth_that_moves_is_no_grid_of_circles() -> None:
    """Its threads become ellipses, nearly, in an even lattice: each alone would do, all that they are not together does
    not."""
    moved = degraded("motion", 6.0, blank("weave", np.random.default_rng(2)), np.random.default_rng(0))[0]
    assert find_grids(np.asarray(moved, np.uint8)) == []


def test_chessboards_are_no_grids_of_circles() -> None:
    for blur_px in (0.7, 2.0):
        rng = np.random.default_rng(5)
        scene = one_board(rng, lens="regular", board=Board("b", 9, 6, 30.0, 30.0))
        assert find_grids(grey_image(scene.render(blur_px=blur_px, noise_levels=2.0, rng=rng))) == []
