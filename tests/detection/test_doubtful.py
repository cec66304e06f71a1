"""What is seen but not trusted is said, with its cause."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from helpers.data import shared_data

from rigkit import detect_boards
from rigkit.benchmark.blanks import blank
from rigkit.core.errors import CheckFailed
from rigkit.detection.doubtful import doubtful_grid
from rigkit.io.images import read_image
from rigkit.workflows.detect import detect_in_images


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
