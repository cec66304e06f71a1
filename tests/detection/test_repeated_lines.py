"""Boards in images that were enlarged by repeating lines are found where they were before, as accurately."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from detection_bench.blanks import BLANKS, blank
from detection_bench.scenes import one_board

from rigkit import detect_boards
from rigkit.core.boards import Board
from rigkit.core.patterns.charuco import Charuco
from rigkit.detection.repeated_lines import without_repeated_lines

FACTORS = [(1.5, 1.5), (1.25, 1.25), (2.0, 2.0), (1.0, 2.0), (1.1, 1.0)]


@pytest.mark.parametrize("factors", FACTORS)
def test_the_image_before_it_was_enlarged(factors: tuple[float, float]) -> None:
    scene = one_board(np.random.default_rng(1))
    image = scene.render(rng=np.random.default_rng(0), supersample=2, noise_levels=2.0)
    # A black margin, as rectified images have, is one long run of equal lines.
    image[:, :30] = 0
    (before,) = detect_boards(image)
    columns, rows = (
        ((np.arange(int(side * k)) + 0.5) / k).astype(int) for side, k in zip(image.shape[::-1], factors, strict=True)
    )
    (found,) = detect_boards(np.dstack([image[rows][:, columns]] * 3))
    # Pixels are counted from their middle; rounding down to whole ones moves them by up to half a line.
    right = (before.pixels + 0.5) * factors - 0.5
    assert np.array_equal(found.grid, before.grid)
    off = found.pixels - right
    assert np.abs(off).max() < 0.5
    assert np.ptp(off, axis=0).max() < 0.01
    assert found.sigma_px == pytest.approx(before.sigma_px * np.sqrt(np.mean(np.square(factors))), rel=0.01)


def test_pictures_stay_as_they_are() -> None:
    for name in list(BLANKS)[::9]:
        assert without_repeated_lines(blank(name, np.random.default_rng(2))) is None, name
    for shape in [(1, 1), (3, 500), (500, 3), (480, 640)]:
        assert without_repeated_lines(np.zeros(shape, np.uint8)) is None
    noise = np.random.default_rng(0).integers(0, 255, (480, 640), np.uint8)
    assert without_repeated_lines(np.repeat(noise, np.arange(480) % 7 // 5 + np.arange(480) // 240 + 1, axis=0)) is None
    margins = np.random.default_rng(0).integers(0, 255, (480, 640, 3), np.uint8)
    margins[400:] = 16
    assert without_repeated_lines(margins) is None


def test_a_drawing_of_squares_of_a_few_pixels_is_found() -> None:
    drawn = 255 * (np.indices((40, 50)).sum(axis=0) % 2).astype(np.uint8)
    image = np.pad(np.kron(drawn, np.ones((8, 8), np.uint8)), 40, constant_values=255)
    repeated = without_repeated_lines(image)
    assert repeated is not None
    assert not detect_boards(repeated.image)
    (found,) = detect_boards(image)
    assert (found.columns, found.rows, found.complete) == (49, 39, True)


def test_a_drawing_whose_markers_are_legible_either_way_stays_exact() -> None:
    """Modules of 4 px are enlarged pixels, too, but their edges are where they were drawn."""
    opencv = cv2.aruco.CharucoBoard((11, 8), 8.0, 6.0, cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50))
    image = np.pad(opencv.generateImage((11 * 32, 8 * 32)), 20, constant_values=255)
    assert without_repeated_lines(np.dstack([image] * 3)) is not None
    (found,) = detect_boards(image, [Board("c", 10, 7, 8.0, 8.0, pattern=Charuco("DICT_4X4_50", 6.0))])
    assert len(found.grid) == 70
    assert np.abs(found.pixels - (32.0 * (found.grid + 1) + 19.5)).max() < 0.002
