"""The size of a chessboard from images that show it in part."""

from __future__ import annotations

import numpy as np
import pytest

from rigkit.core.detections import BoardDetection
from rigkit.detection.whole_grids import GridExtent, Size, board_size_in, grid_extent, other_sizes

WHOLE = (True, True)
ONE_SIDE = (True, False)


def seen(*sizes: Size, ends: tuple[bool, bool] = WHOLE) -> list[list[GridExtent]]:
    """Return images that show a grid each."""
    return [[GridExtent(size, ends)] for size in sizes]


def test_corners_seen_outweigh_corners_missed() -> None:
    """The rim of a fisheye hides two columns of three images."""
    assert board_size_in(seen((8, 7), (8, 7), (8, 7), (10, 7), (10, 7))) == (((10, 7),), (3, 4))


def test_a_row_beside_the_board_is_none_of_it() -> None:
    assert board_size_in(seen(*[(9, 6)] * 4, (10, 6))) == (((9, 6),), (0, 1, 2, 3))


def test_images_that_do_not_decide_between_two_sizes() -> None:
    reported = board_size_in(seen(*[(9, 6)] * 5, (10, 6), (10, 6)))
    assert reported is not None and set(reported[0]) == {(9, 6), (10, 6)}


def test_parts_of_other_lengths_are_no_board() -> None:
    """Two are alike by chance; each of the others has more, and none is seen twice."""
    reported = board_size_in(seen((8, 7), (8, 7), (9, 7), (10, 7), (11, 7)))
    assert reported is not None and len(reported[0]) == 2 and reported[0][0] == (8, 7)


def test_a_board_whose_last_line_blur_hides() -> None:
    """One side is seen to end, of the other a few corners of the last line are; no image shows more."""
    assert board_size_in([*seen((8, 8), (8, 8), ends=ONE_SIDE), *seen((8, 5), (8, 6))]) == (((8, 8),), (0, 1))
    # Where the frame cuts it there may be more.
    cut = [[GridExtent((8, 8), ONE_SIDE, cut=True)]] * 2
    assert board_size_in([*cut, *seen((8, 5), (8, 6))]) is None


def test_another_board_beside_the_stated_one_is_no_contradiction() -> None:
    both = [[GridExtent((9, 6), WHOLE), GridExtent((12, 9), WHOLE)]] * 2
    assert board_size_in([*both, *seen(*[(9, 6)] * 3, (12, 9), (12, 9))]) == (((9, 6),), (0, 1, 2, 3, 4))


def test_what_most_images_show_beside_the_board() -> None:
    three = [GridExtent((8, 6), WHOLE), GridExtent((8, 6), WHOLE), GridExtent((7, 6), ONE_SIDE)]
    assert other_sizes([three, three, [GridExtent((8, 6), WHOLE)]], (8, 6), (0, 1, 2)) == ((7, 6),)
    assert other_sizes([three, [GridExtent((8, 6), WHOLE)]], (8, 6), (0, 1)) == ()


@pytest.mark.parametrize(("missing", "ends"), [(0, WHOLE), (5, ONE_SIDE)])
def test_a_grid_ends_where_most_of_its_last_line_is_seen(missing: int, ends: tuple[bool, bool]) -> None:
    row, column = np.indices((6, 8)).reshape(2, -1)
    grid = np.stack([column, row], axis=1)[missing:]
    pixels = np.asarray(60.0 + 40.0 * grid, np.float64)
    board = BoardDetection(None, 8, 6, grid, pixels, np.array([0.1] * len(grid), np.float64))
    image = np.full((500, 500), 128, np.uint8)
    assert grid_extent(board, image) == GridExtent((8, 6), ends)
    cut = grid_extent(board, image[:290])
    assert cut is not None and cut.cut


@pytest.mark.parametrize("rows", [6, 9])
def test_a_grid_goes_on_where_squares_are_seen_beyond_its_last_corners(rows: int) -> None:
    """Six rows of corners were found; a board of nine has fainter squares below them."""
    v, u = np.indices((500, 500))
    squares = (((u - 60) // 40 + (v - 60) // 40) % 2 == 0) & (u >= 20) & (u < 380) & (v >= 20) & (v < 60 + 40 * rows)
    image = np.where(squares, 40, 200).astype(np.float64)
    image = 120.0 + (image - 120.0) * np.where(v < 280, 1.0, 0.25)
    image += np.random.default_rng(1).normal(0.0, 2.0, image.shape)
    row, column = np.indices((6, 8)).reshape(2, -1)
    grid = np.stack([column, row], axis=1)
    pixels = (60.0 + 40.0 * grid).astype(np.float64)
    board = BoardDetection(None, 8, 6, grid, pixels, np.full(len(grid), 0.1))
    assert grid_extent(board, np.clip(image, 0, 255).astype(np.uint8)) == GridExtent((8, 6), (True, rows == 6))
