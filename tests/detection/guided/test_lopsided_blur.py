"""Lopsided blur moves neighbouring corners alike: further blur shows by how much, and sigmas include it."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from detection_bench.scenes import one_board

from rigkit.core.boards import Board
from rigkit.core.patterns.charuco import Charuco
from rigkit.detection.detect import detect_boards
from rigkit.detection.guided.lopsided_blur import blur_shift_px, common_variance, relative_gradient
from rigkit.detection.lattices import find_lattices

PLAIN = Board("b", 9, 6, 30.0, 30.0)
MARKED = Board("b", 8, 6, 30.0, 30.0, pattern=Charuco("DICT_4X4_250", 23.0))
TAIL = np.outer([0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0], [0.0, 0.0, 0.0, 0.0, 0.7, 0.12, 0.08, 0.06, 0.04])
"""A kernel that leaves 0.3 of the light up to 4 px to one side."""


def _pictures(board: Board, blur_px: float, tail: np.ndarray | None) -> tuple[np.ndarray, np.ndarray]:
    """Return the image of a board under uneven light in focus, and that with `tail` and further blur."""
    rng = np.random.default_rng(3)
    scene = one_board(rng, board=board, square_px=40.0, max_tilt_deg=25.0, size_px=(640, 480))
    sharp = scene.render(blur_px=0.5).astype(np.float32)
    if tail is not None:
        sharp = np.asarray(cv2.filter2D(sharp, -1, tail), np.float32)
    blurred = cv2.GaussianBlur(sharp, (0, 0), blur_px) + rng.standard_normal(sharp.shape)
    in_focus, out_of_focus = (np.clip(np.rint(part), 0, 255).astype(np.uint8) for part in (sharp, blurred))
    return in_focus, out_of_focus


@pytest.mark.parametrize(("tail", "low_px", "high_px"), [(None, 0.0, 0.006), (TAIL, 0.03, 0.3)])
def test_the_shift_of_lopsided_blur_is_measured(tail: np.ndarray | None, low_px: float, high_px: float) -> None:
    sharp, blurred = _pictures(PLAIN, 2.0, tail)
    (item,) = find_lattices(blurred, 12)
    assert item.lattice.count == 54
    assert low_px <= blur_shift_px(blurred, item, PLAIN) <= high_px
    (item,) = find_lattices(sharp, 12)
    assert blur_shift_px(sharp, item, PLAIN) == 0.0


def test_sigmas_of_marked_boards_include_it() -> None:
    """The tail is shorter than the blur, so that most of its shift is over: 2.4 sigmas, and 8 if they leave it out."""
    sharp, blurred = _pictures(MARKED, 2.0, TAIL)
    before, after = (detect_boards(image, [MARKED])[0] for image in (sharp, blurred))
    assert before.complete
    assert after.complete
    moved = (after.pixels - before.pixels) / after.sigma_px[:, None]
    assert 0.5 < np.sqrt((moved**2).mean()) < 3.0


def test_only_what_neighbours_share_counts() -> None:
    rng = np.random.default_rng(1)
    alone = 0.05 * rng.standard_normal((20, 30, 2))
    assert common_variance(alone) < 0.01**2
    both = common_variance(alone + np.array([0.03, -0.04]))
    assert 0.8 * 0.05**2 / 2.0 < both < 1.2 * 0.05**2 / 2.0
    few = np.full((3, 3, 2), 0.1)
    assert common_variance(few) == 0.0


def test_the_gradient_of_light_is_that_of_the_contrast() -> None:
    pixels = np.random.default_rng(2).uniform(0.0, 500.0, (40, 2))
    light = np.exp(0.002 * pixels[:, 0] - 3e-6 * (pixels[:, 1] - 100.0) ** 2)
    light[7] = np.nan
    expected = np.stack([np.full(40, 0.002), -6e-6 * (pixels[:, 1] - 100.0)], axis=1)
    assert np.allclose(relative_gradient(pixels, 90.0 * light), expected, rtol=1e-6, atol=1e-9)
