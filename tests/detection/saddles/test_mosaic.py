"""Raw images of colour cameras are recognised and brought to one scale."""

from __future__ import annotations

import numpy as np
import pytest
from detection_bench.blanks import BLANKS, blank
from detection_bench.scenes import one_board

from rigkit import detect_boards
from rigkit.detection.saddles.mosaic import without_mosaic

RED_GREEN_BLUE = np.array([[0.45, 1.0], [1.0, 0.6]])
"""What a sensor's colours see of white light, relative to green."""


@pytest.mark.parametrize("black_level", [0.0, 16.0])
def test_a_mosaic_is_as_good_as_grey(black_level: float) -> None:
    scene = one_board(np.random.default_rng(1))
    grey = scene.render(rng=np.random.default_rng(0), blur_px=0.7, noise_levels=1.0)
    height, width = grey.shape
    colours = np.tile(RED_GREEN_BLUE, (height // 2, width // 2))
    raw = np.clip(np.rint(0.9 * grey * colours + black_level), 0, 255).astype(np.uint8)
    (truth,) = scene.truth()

    def rms_px(image: np.ndarray) -> float:
        (found,) = detect_boards(image)
        assert found.complete
        off = np.linalg.norm(found.pixels[:, None] - truth.pixels, axis=2).min(axis=1)
        return float(np.sqrt((off**2).mean()))

    # Half of the pixels see half of the light, so that noise and rounding count for more.
    assert rms_px(raw) < 2.0 * rms_px(grey)


def test_images_of_one_colour_stay_as_they_are() -> None:
    for name in BLANKS:
        picture = blank(name, np.random.default_rng(2))
        assert without_mosaic(picture) is picture, name


def test_dots_of_a_print_are_no_mosaic() -> None:
    """An image of two levels by ordered dither has positions without any light."""
    grey = one_board(np.random.default_rng(1)).render(rng=np.random.default_rng(0), blur_px=0.7)
    order = 16 * np.array([[0, 8, 2, 10], [12, 4, 14, 6], [3, 11, 1, 9], [15, 7, 13, 5]]) + 8
    height, width = grey.shape
    dots = 255 * (0.6 * grey > np.tile(order, (height // 4, width // 4))).astype(np.uint8)
    assert without_mosaic(dots) is dots
