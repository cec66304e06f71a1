"""The corners in which lattices are searched, at twice the resolution too."""

from __future__ import annotations

import numpy as np
from detection_bench.blanks import blank
from detection_bench.scenes import three_boards

from rigkit.core.arrays import FloatArray
from rigkit.detection.saddles.response import enlarged_level, grey_image, pyramid
from rigkit.detection.saddles.saddle import dense, find_corners
from rigkit.detection.searched_image import FINE_CORNERS, SearchedImage


def squares(side_px: int, columns: int, rows: int) -> FloatArray:
    """Return the corners (N, 2) of a board with squares of `side_px`."""
    return 200.0 + side_px * np.argwhere(np.ones((columns, rows))).astype(np.float64)


def test_a_finer_level_is_added_as_if_all_levels_were_searched_again(rng: np.random.Generator) -> None:
    grey = grey_image(three_boards(rng).render(rng=rng, blur_px=0.7, noise_levels=3.0))
    ours = SearchedImage.of(grey).with_enlarged()
    corners, saddles = find_corners([enlarged_level(grey), *pyramid(grey)])
    assert len(corners) > 100
    for one, other in ((ours.corners, corners), (ours.saddles.smeared, saddles.smeared)):
        assert np.array_equal(one.pixels, other.pixels) and np.array_equal(one.angles, other.angles)
    assert np.array_equal(ours.saddles.pixels, saddles.pixels)


def test_small_squares_are_where_points_are_dense(rng: np.random.Generator) -> None:
    level = pyramid(grey_image(blank("texture", rng, (640, 480))))[0]
    apart = rng.uniform((20.0, 20.0), (620.0, 460.0), (30, 2))
    for side_px, found in ((6, True), (4, True), (12, False)):
        for size in ((8, 3), (5, 5)):
            board = squares(side_px, *size)
            assert dense(np.concatenate([apart, board]), level, FINE_CORNERS)[len(apart) :].all() == found
