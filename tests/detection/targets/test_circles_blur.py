"""Circle grids out of focus: neither neighbours' light nor noise that was smoothed makes sigmas wrong."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from detection_bench.scenes import one_board

from rigkit.core.boards import Board
from rigkit.core.patterns.circles import Circles
from rigkit.detection.circles.search import find_grids
from rigkit.detection.saddles.response import grey_image

REGULAR = Board("r", 10, 8, 25.0, 25.0, pattern=Circles(diameter_mm=15.0))
HEXAGONAL = Board("h", 12, 9, 20.0, 20.0, pattern=Circles("hexagonal", diameter_mm=15.0))


@pytest.mark.parametrize(
    ("board", "blur_px", "smoothed_px"),
    [(REGULAR, 3.0, 0.0), (HEXAGONAL, 2.0, 0.0), (REGULAR, 0.7, 1.5)],
    ids=["blurred", "blurred into neighbours", "smoothed after the noise"],
)
def test_sigmas_hold_where_blur_joins_circles_or_neighbouring_pixels(
    board: Board, blur_px: float, smoothed_px: float
) -> None:
    """White noise alone says a quarter of what noise does that was smoothed after it came."""
    off, sigma = [], []
    for seed in range(3):
        rng = np.random.default_rng(seed)
        scene = one_board(rng, lens="regular", board=board)
        image = grey_image(scene.render(blur_px=blur_px, noise_levels=4.0, rng=rng))
        if smoothed_px:
            image = np.asarray(cv2.GaussianBlur(image, (0, 0), smoothed_px), np.float32)
        truth = scene.truth()[0].pixels
        for found in find_grids(image):
            nearest = np.linalg.norm(found.pixels[:, None] - truth, axis=2).argmin(axis=1)
            off.append(found.pixels - truth[nearest])
            sigma.append(found.sigma_px)
    ratio = np.concatenate(off) / np.concatenate(sigma)[:, None]
    assert len(ratio) > 200
    assert 0.8 < np.sqrt((ratio**2).mean()) < 1.25


def test_blur_brings_no_light_of_neighbours_into_sizes() -> None:
    """Circles that end half their radius from the next seem smaller under blur, and those at the rim lie off."""
    board = Board("tight", 10, 8, 25.0, 25.0, pattern=Circles("hexagonal", diameter_mm=20.0))
    scene = one_board(np.random.default_rng(2), lens="regular", board=board)
    found = find_grids(grey_image(scene.render(blur_px=1.8)))[0]
    truth = scene.truth()[0].pixels
    off = np.linalg.norm(found.pixels[:, None] - truth, axis=2).min(axis=1)
    assert len(found) == board.corner_count
    # Each circle fitted as if it were alone: 0.3969 and 0.017 px.
    assert found.radius == pytest.approx(0.4, abs=0.001)
    assert np.sqrt((off**2).mean()) < 0.005
