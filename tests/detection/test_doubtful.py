"""What is seen but not trusted is said, with its cause."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from helpers.data import shared_data

from rigkit import detect_boards
from rigkit.benchmark.blanks import blank
from rigkit.benchmark.scenes import one_board
from rigkit.core.boards import Board
from rigkit.core.errors import CheckFailed
from rigkit.detection.doubtful import doubtful_grid
from rigkit.io.images import read_image
from rigkit.workflows.detect import detect_in_images

HONEST_RATIO = 1.6
"""Largest rms of errors over their sigmas of a board blurred by two fifths of a square: measured 0.9 to 1.3."""


def too_blurred() -> np.ndarray:
    image = read_image(shared_data("real/bouguet-stereo") / "left07.jpg")
    return cv2.GaussianBlur(image, (0, 0), 7.0)


def test_a_board_too_blurred_to_be_trusted_is_named(tmp_path: Path) -> None:
    image = too_blurred()
    assert not detect_boards(image)
    words = doubtful_grid(image)
    assert words is not None
    assert "grid is seen" in words
    assert words.endswith("blurred")
    cv2.imwrite(str(tmp_path / "a.png"), image)
    with pytest.raises(CheckFailed, match="grid is seen"):
        detect_in_images([tmp_path / "a.png"])


@pytest.mark.parametrize("name", ["noise", "text", "texture"])
def test_of_pictures_without_any_grid_nothing_is_said(name: str) -> None:
    assert doubtful_grid(blank(name, np.random.default_rng(0))) is None


@pytest.mark.parametrize("seed", [0, 1])
def test_a_blurred_board_of_a_declared_size_is_kept_with_sigmas_that_hold(seed: int) -> None:
    """Nobody takes it for a board who does not know that such a board is there."""
    rng = np.random.default_rng(seed)
    scene = one_board(rng)
    truth = scene.truth()[0]
    image = scene.render(blur_px=6.5 + 0.5 * seed, noise_levels=2.0, rng=rng)
    assert not detect_boards(image)
    board = Board("b", truth.columns, truth.rows, 30.0, 30.0)
    (found,) = detect_boards(image, [board])
    assert found.board_id == "b"
    assert len(found.grid) >= 0.9 * len(truth.grid)
    nearest = np.linalg.norm(found.pixels[:, None] - truth.pixels, axis=2).argmin(axis=1)
    off = (found.pixels - truth.pixels[nearest]) / found.sigma_px[:, None]
    assert np.median(found.sigma_px) > 0.05
    assert 0.6 < np.sqrt((off**2).mean()) < HONEST_RATIO
    other = Board("b", truth.columns, truth.rows + 1, 30.0, 30.0)
    assert not detect_boards(image, [other])


@pytest.mark.parametrize("name", ["left03.jpg", "left04.jpg", "left05.jpg"])
def test_a_board_in_the_background_takes_no_name_from_one_that_is_sure(name: str) -> None:
    """A second board of that size, of squares of 5 px, stands beside the window."""
    image = read_image(shared_data("real/bouguet-stereo") / name)
    (found,) = detect_boards(image, [Board("b", 9, 6, 30.0, 30.0)])
    assert found.board_id == "b"
    assert found.pixels[:, 0].min() > 100.0
