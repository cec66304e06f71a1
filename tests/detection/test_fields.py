"""Boards in images whose even and odd lines show them at places far apart are found in the even ones."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from detection_bench.blanks import BLANKS, blank
from detection_bench.scenes import one_board

from rigkit import detect_boards
from rigkit.core.arrays import FloatArray
from rigkit.detection.fields import of_one_moment


def interlaced(moves: tuple[float, float]) -> tuple[np.ndarray, FloatArray]:
    """Return an image whose odd lines show a board `moves` px further, and its corners in the even
    ones (N, 2)."""
    scene = one_board(np.random.default_rng(1))
    # Cameras of two fields add neighbouring lines, which is a blur.
    image = scene.render(rng=np.random.default_rng(0), blur_px=1.0, noise_levels=1.0)
    matrix = np.array([[1.0, 0.0, moves[0]], [0.0, 1.0, moves[1]]])
    later = cv2.warpAffine(image, matrix, image.shape[::-1], flags=cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
    image[1::2] = later[1::2]
    (truth,) = scene.truth()
    return image, truth.pixels


@pytest.mark.parametrize("moves", [(5.0, 0.0), (-12.0, 0.0), (7.0, 6.0), (0.0, 10.0)])
def test_a_moving_board_is_found_where_the_even_lines_show_it(moves: tuple[float, float]) -> None:
    image, truth = interlaced(moves)
    (found,) = detect_boards(image)
    assert found.complete
    apart = found.pixels[:, None] - truth
    off = apart[np.arange(len(truth)), np.linalg.norm(apart, axis=2).argmin(axis=1)]
    assert np.sqrt((off**2).mean()) < 0.03
    assert np.sqrt((off**2 / found.sigma_px[:, None] ** 2).mean()) < 1.5


@pytest.mark.parametrize("moves", [(0.0, 0.0), (2.0, 0.0)])
def test_lines_that_agree_are_all_used(moves: tuple[float, float]) -> None:
    image, _ = interlaced(moves)
    assert of_one_moment(image) is image


def test_pictures_and_lines_of_a_screen_stay_as_they_are() -> None:
    for name in BLANKS:
        picture = blank(name, np.random.default_rng(2))
        assert of_one_moment(picture) is picture, name
    board, _ = interlaced((0.0, 0.0))
    board[1::2] //= 2
    assert of_one_moment(board) is board
    tiny = board[:20, :20]
    assert of_one_moment(tiny) is tiny


@pytest.mark.parametrize("period_px", [1.95, 2.1, 2.5])
def test_lines_as_fine_as_pixels_beside_a_board_are_no_fields(period_px: float) -> None:
    # Blinds and fabrics: every second line shows them with a period so long that the others match it elsewhere.
    image, _ = interlaced((0.0, 0.0))
    down, across = np.indices(image.shape)
    lines = 120.0 + 30.0 * np.sin(2.0 * np.pi * (down + 0.02 * across) / period_px)
    image[:, -160:] = lines[:, -160:]
    assert of_one_moment(image) is image


def test_one_tile_of_two_moments_is_chance() -> None:
    image, _ = interlaced((0.0, 0.0))
    texture = np.random.default_rng(3).integers(0, 256, (480, 640)).astype(np.uint8)
    cv2.GaussianBlur(texture, (0, 0), 2.0, dst=texture)
    cv2.normalize(texture, texture, 0, 255, cv2.NORM_MINMAX)
    texture[1::2] = np.roll(texture, 8, axis=1)[1::2]
    height, width = image.shape
    one = (slice(0, height // 8), slice(0, width // 8))
    image[one] = texture[one]
    assert of_one_moment(image) is image
    two = (slice(0, height // 8), slice(0, 2 * (width // 8)))
    image[two] = texture[two]
    assert of_one_moment(image) is not image
