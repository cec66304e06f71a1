"""A wrong board size in the board file is distinguished from boards cut by the frame."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from rigkit.calibration.views.usable import other_size, views_of_image, without_lookalikes
from rigkit.core.boards import Board
from rigkit.core.detections import BoardDetection
from rigkit.core.patterns.aprilgrid import AprilGrid
from rigkit.core.patterns.circles import Circles

STATED = (Board("stated", 9, 7, 30.0, 30.0),)


def grid(columns: int, rows: int, *, corners: int | None = None) -> BoardDetection:
    cells = np.stack(np.meshgrid(np.arange(columns), np.arange(rows)), axis=-1).reshape(-1, 2)
    # The outer corners stay, so that the size does.
    kept = np.r_[np.arange(columns * rows - 1)[:corners], columns * rows - 1]
    return BoardDetection(
        None, columns, rows, cells[kept], np.asarray(20.0 * cells[kept] + 50.0), np.full(len(kept), 0.05)
    )


def shown(*grids: BoardDetection) -> dict[str, list[BoardDetection]]:
    return {f"{k}.png": [one] for k, one in enumerate(grids)}


def test_whole_grids_of_another_size_are_other_boards() -> None:
    words = other_size(shown(grid(9, 6), grid(9, 6), grid(9, 6), grid(9, 6), grid(8, 5)), STATED)
    assert words == "9 x 6 inner corners are seen in 4 of 5 images, 9 x 7 are declared"
    tags = Board("tags", 10, 8, 30.0, 30.0, pattern=AprilGrid(0.3))
    words = other_size(shown(grid(9, 6), grid(9, 6), grid(9, 6), grid(9, 6)), (*STATED, tags))
    assert words == "9 x 6 inner corners are seen in 4 of 4 images, 9 x 7, 5 x 4 tags are declared"


def test_a_larger_board_of_which_part_was_taken() -> None:
    declared = (Board("b", 8, 6, 30.0, 30.0),)
    mostly = shown(*[grid(9, 6)] * 7, *[grid(8, 6)] * 7)
    assert other_size(mostly, declared) == "9 x 6 inner corners are seen in 7 of 14 images, 8 x 6 are declared"
    assert other_size(shown(*[grid(9, 6)] * 3, *[grid(8, 6)] * 20), declared) is None
    # Another board beside the declared one is no reason to doubt that.
    assert other_size({f"{k}.png": [grid(8, 6), grid(9, 6)] for k in range(10)}, declared) is None


def test_a_larger_board_that_was_cut() -> None:
    """A 9x6 board declared as 6x4: in most images it comes in two pieces."""
    declared = (Board("b", 6, 4, 30.0, 30.0),)
    first, rest = grid(6, 5), grid(6, 4)
    below = replace(rest, pixels=rest.pixels + np.array([0.0, 100.0]))
    beside = replace(rest, pixels=rest.pixels + np.array([160.0, 0.0]))
    cut = {f"{k}.png": [first, below] for k in range(8)}
    whole = {f"whole{k}.png": [grid(9, 6)] for k in range(3)}
    assert other_size(cut | whole, declared) == "9 x 6 inner corners are seen in 11 of 11 images, 6 x 4 are declared"
    # Two boards that stand apart are two.
    assert other_size({f"{k}.png": [first, beside] for k in range(8)}, declared) is None


def test_a_smaller_board_that_passes_for_part_of_the_stated_one() -> None:
    part = grid(9, 6)
    as_part = BoardDetection("stated", 9, 7, part.grid, part.pixels, part.sigma_px)
    reaching = grid(9, 7, corners=55)
    smaller = {f"{k}.png": [one] for k, one in enumerate([part] * 7 + [as_part] * 3 + [reaching])}
    assert other_size(smaller, STATED) == "9 x 6 inner corners are seen in 7 of 11 images, 9 x 7 are declared"
    # Tiles beside it, larger and smaller ones, are no reason to doubt that.
    tiled = {name: [*own, grid(4, 3), grid(8, 4)] for name, own in smaller.items()}
    assert other_size(tiled, STATED) == other_size(smaller, STATED)
    seen = {f"{k}.png": [one] for k, one in enumerate([part] * 7 + [reaching] * 3)}
    assert other_size(seen, STATED) is None


def test_parts_of_the_stated_board_are_no_larger_board() -> None:
    assert other_size(shown(grid(9, 6), grid(8, 7), grid(9, 5), grid(7, 7), grid(9, 6)), STATED) is None
    assert other_size(shown(*[grid(9, 6)] * 4, grid(7, 9, corners=40)), STATED) is None
    assert other_size(shown(*[grid(9, 6)] * 2), STATED) is None
    assert other_size(shown(*[grid(9, 6, corners=50)] * 5), STATED) is None
    assert other_size({}, STATED) is None


def left(found: dict[str, list[BoardDetection]], boards: tuple[Board, ...] = STATED) -> list[list[int]]:
    return [[len(d.grid) for d in own] for own in without_lookalikes(found, boards).values()]


def test_tiles_beside_the_whole_board_are_no_part_of_it() -> None:
    whole, tiles = grid(9, 7), grid(5, 4)
    assert left({"0.png": [whole, tiles], "1.png": [tiles], "2.png": [tiles, grid(7, 9)]}) == [[63], [20], [63]]
    # A board that is named is one, though only its lower half is seen.
    half = BoardDetection("stated", 9, 7, whole.grid[27:], whole.pixels[27:], whole.sigma_px[27:])
    assert left({"0.png": [half, tiles]}) == [[36]]
    # A patch of tiles may have the board's size, but seldom all of its corners.
    assert left({"0.png": [whole, grid(9, 7, corners=55)], "1.png": [grid(9, 7, corners=55)]}) == [[63], [56]]
    # A part of another board that is listed is welcome while that one is not seen.
    assert left({"0.png": [whole, tiles]}, (*STATED, Board("second", 6, 5, 30.0, 30.0))) == [[63, 20]]


def test_parts_of_copies_of_the_board_are_used() -> None:
    whole, part = grid(9, 7), grid(5, 4)
    assert left({"0.png": [whole, whole, part], "1.png": [whole, part]}) == [[63, 63, 20], [63, 20]]
    # Tiles that pass for the whole board once in many images make no copies.
    assert left({str(k): [whole] * (1 + (k == 0)) + [part] for k in range(8)}) == [[63, 63], *[[63]] * 7]


def test_a_picture_of_a_board_on_the_wall_is_not_the_board() -> None:
    whole = grid(9, 7)
    small = BoardDetection(None, 9, 7, whole.grid, 0.2 * whole.pixels, whole.sigma_px)
    found = {str(k): [whole, small] if k == 0 else [whole] for k in range(8)}
    first = without_lookalikes(found, STATED)["0"]
    assert [d.board_id for d in first] == ["stated"] and np.array_equal(first[0].pixels, whole.pixels)
    # One nearly as large may be a second board, and so may a small one that images often show.
    near = BoardDetection(None, 9, 7, whole.grid, 0.7 * whole.pixels, whole.sigma_px)
    assert left({**found, "0": [whole, near]})[0] == [63, 63]
    assert left({str(k): [whole, small] for k in range(4)})[0] == [63, 63]


@pytest.mark.parametrize("layout", ["regular", "asymmetric", "hexagonal"])
@pytest.mark.parametrize("stagger", ["right", "left"])
def test_a_part_of_a_grid_of_circles_keeps_its_stagger(layout: str, stagger: str) -> None:
    board = Board("c", 4, 11, 40.0, 40.0, pattern=Circles(layout, stagger))
    (view,), why = views_of_image("cut.png", [grid(3, 8)], [board])
    assert why is None and view.board.board_id == "c part of cut.png"
    np.testing.assert_allclose(view.points(), board.points(view.grid))
    # Staggered rows are not turned: along the columns nothing is half a step aside.
    (lying,), _ = views_of_image("cut.png", [grid(3, 2)], [board])
    assert lying.board.size == (3, 2)
    assert (views_of_image("cut.png", [grid(8, 3)], [board])[0] == []) == (layout != "regular")
