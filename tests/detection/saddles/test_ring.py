"""The ring test: directions at corners of known angles, and patterns that it must reject."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from helpers.detection_scenes import dots, single

from rigkit.core.boards import Board
from rigkit.detection.detect import detect_boards
from rigkit.detection.saddles.response import grey_image, pyramid
from rigkit.detection.saddles.ring import ring_rules
from rigkit.detection.saddles.saddle import MAX_STEP, NOWHERE, RING_RADIUS, find_corners
from rigkit.kernels import front

DIRECTION_DEG = 3.0
"""Of lines through an ideal corner of 25 degrees: sampled pixels and bilinear reads are no Gaussian. The places
where the ring crosses half its contrast are off by 25."""

FINE = 8
"""Sub-pixels of the ideal corners, per pixel and direction."""


def ideal_corner(first_deg: float, opening_deg: float, blur_px: float) -> np.ndarray:
    """Return a 33x33 image of two dark and two bright quadrants that meet in its middle; the bright ones begin at
    `first_deg` and open by `opening_deg`."""
    place = (np.arange(33 * FINE) + 0.5) / FINE - 16.5
    angle = np.degrees(np.arctan2(place[:, None], place[None])) - first_deg
    bright = (40.0 + 160.0 * (angle % 180.0 < opening_deg)).astype(np.float32)
    smooth = cv2.GaussianBlur(bright, (0, 0), blur_px * FINE)
    return smooth.reshape(33, FINE, 33, FINE).mean(axis=(1, 3))


def corner_at(image: np.ndarray, at: tuple[int, int], radius: float) -> np.ndarray:
    """Return the angles (N, 2) of the corner next to the pixel `at`, N = 0 for none."""
    place, response = np.array([at], np.int32), np.zeros(1, np.float32)
    rules, tests = ring_rules(), (radius, MAX_STEP, np.inf)
    return front.corners(image, place, response, tests, rules, (1.0, 0.0), NOWHERE, 0.0).angles


@pytest.mark.parametrize("opening", [25.0, 50.0, 90.0, 130.0, 155.0])
@pytest.mark.parametrize("blur", [1.0, 1.5, 2.0])
@pytest.mark.parametrize("radius", [RING_RADIUS, 4.6])
def test_directions_of_blurred_corners(opening: float, blur: float, radius: float) -> None:
    for first in (0.0, 33.0, 100.0, 170.0):
        image = ideal_corner(first, opening, blur).astype(np.float32)
        rising, falling = np.degrees(corner_at(image, (16, 16), radius)[0])
        assert 0.0 <= rising < 180.0
        assert abs((rising - first + 90.0) % 180.0 - 90.0) < DIRECTION_DEG
        assert abs((falling - first - opening + 90.0) % 180.0 - 90.0) < DIRECTION_DEG
        assert 0.0 < falling - rising < 180.0


def test_ring_beyond_the_squares_is_refused() -> None:
    """On a board of 5 px squares a ring of 4.6 px reads the next squares, though it is symmetric all the same."""
    fine = (np.arange(40 * FINE) // (5 * FINE))[:, None] + np.arange(40 * FINE) // (5 * FINE)
    image = (fine % 2 * 160.0 + 40.0).reshape(40, FINE, 40, FINE).mean(axis=(1, 3)).astype(np.float32)
    image = np.asarray(cv2.GaussianBlur(image, (0, 0), 1.0), np.float32)
    assert len(corner_at(image, (19, 19), RING_RADIUS)) == 1
    assert len(corner_at(image, (19, 19), 6.0)) == 0


def test_dots_and_noise_have_hardly_any_corners(rng: np.random.Generator) -> None:
    corners, saddles = find_corners(pyramid(grey_image(dots((400, 300), 9))))
    assert len(saddles.pixels) > 200
    assert len(corners) < 0.02 * len(saddles.pixels)
    corners, saddles = find_corners(pyramid(grey_image((rng.random((480, 640)) * 255).astype(np.uint8))))
    assert len(corners) < 0.12 * len(saddles.pixels)


@pytest.mark.parametrize("blur", [0.5, 1.0])
def test_foreshortened_by_80_degrees(blur: float, rng: np.random.Generator) -> None:
    """Squares of 38 x 6.6 px."""
    scene = single(Board("a", 9, 6, 30.0, 30.0), [np.radians(80.0), 0.0, 0.0], 430.0)
    (found,) = detect_boards(scene.image(rng, blur_px=blur))
    assert found.complete


def test_every_corner_of_a_flat_board_is_a_seed(rng: np.random.Generator) -> None:
    """75 degrees; directions against those of the rows and columns of the rendered geometry."""
    scene = single(Board("a", 9, 6, 30.0, 30.0), [np.radians(75.0), 0.0, 0.4], 500.0)
    truth = scene.truth()[0][1]
    assert len(truth) == 54
    corners, _ = find_corners(pyramid(grey_image(scene.image(rng, blur_px=1.0))))
    gap = np.linalg.norm(corners.pixels[:, None] - truth, axis=2)
    assert (gap.min(axis=0) < 0.5).all()
    grid = truth.reshape(6, 9, 2)
    lines = [np.gradient(grid, axis=axis).reshape(-1, 2) for axis in (0, 1)]
    angles = corners.angles[gap.argmin(axis=0)]
    off = [np.abs(np.sin(angles - np.arctan2(line[:, 1], line[:, 0])[:, None])).min(axis=1) for line in lines]
    assert np.degrees(np.arcsin(np.median(off))) < 3.0
