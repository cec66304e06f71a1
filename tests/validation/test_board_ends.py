"""A chessboard declared with more columns or rows than both images show ends there is contradicted; a cover is not."""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import cv2
import numpy as np
import pytest
from helpers.board_scenes import regular_camera
from helpers.reconstructions import BOARDS
from numpy.typing import NDArray

from rigkit.core.boards import Board
from rigkit.core.detections import BoardDetection
from rigkit.core.posetype import PoseType
from rigkit.reconstruction.pairing import match_pair
from rigkit.synthetic.pairs import StereoScene, trihedral_pair
from rigkit.validation.board_ends import BeyondCorners, _corners_shown, contradicted_counts
from rigkit.validation.check import Check

Shown = tuple[StereoScene, tuple[NDArray[Any], NDArray[Any]]]
COLUMNS, ROWS = BOARDS[0].size


@functools.cache
def shown() -> Shown:
    rng = np.random.default_rng(5)
    scene = trihedral_pair(BOARDS, regular_camera(), PoseType.STANDARD, rng, distance=(1.0, 1.4), walls=False)
    return scene, scene.images()


def contradicted(
    images: tuple[NDArray[Any], NDArray[Any]],
    declared: Board,
    kept: Callable[[BoardDetection], BoardDetection] | None = None,
) -> tuple[Check, ...]:
    """Check the pair with its first board `declared`, and its corners as `kept` leaves them."""
    scene, _ = shown()
    first, second = ([(kept or (lambda d: d))(found[0]), *found[1:]] for found in scene.detections())
    pair = match_pair("made", scene.camera1, scene.camera2, first, second, [declared, *BOARDS[1:]])
    assert declared.board_id in [board.board_id for board in pair.boards]
    return contradicted_counts(pair, images)


@pytest.mark.parametrize(("more", "name"), [((2, 0), "columns"), ((0, 1), "rows")])
def test_a_board_that_ends_before_its_declared_corners_fails_with_its_size(more: tuple[int, int], name: str) -> None:
    _, images = shown()
    declared = replace(BOARDS[0], columns=COLUMNS + more[0], rows=ROWS + more[1])
    (check,) = contradicted(images, declared)
    assert not check.passed and check.kind == "board size" and check.name == f"{name} {declared.board_id}"
    axis = more.index(max(more))
    assert (check.measured, check.ours) == (declared.size[axis], BOARDS[0].size[axis])
    assert f"{COLUMNS} x {ROWS}" in check.how


@pytest.mark.parametrize("depth", [0.75, 1.3, 3.0])
def test_a_cover_over_the_last_columns_of_both_images_contradicts_nothing(depth: float) -> None:
    """It ends `depth` squares beyond the last corner that is left: of a board as declared, and of one with one
    more column. At 3 it is beside the board, of which corners were not found."""
    scene, images = shown()
    covered = []
    for image, found in zip(images, scene.detections(), strict=True):
        corners = found[0].lattice().astype(np.float32)
        square = [[0, 0], [COLUMNS - 1, 0], [COLUMNS - 1, ROWS - 1], [0, ROWS - 1]]
        at = np.array([corners[row, column] for column, row in square])
        onto = cv2.getPerspectiveTransform(np.array(square, np.float32), at)
        edge = COLUMNS - 3 + depth
        cover = np.array([[[edge, -2], [COLUMNS + 1, -2], [COLUMNS + 1, ROWS + 1], [edge, ROWS + 1]]], np.float32)
        painted: NDArray[np.uint8] = image.astype(np.uint8)
        cv2.fillPoly(painted, [np.round(cv2.perspectiveTransform(cover, onto)).astype(np.int32)], 128.0)
        covered.append(painted)

    def left(found: BoardDetection) -> BoardDetection:
        seen = found.grid[:, 0] < COLUMNS - 2
        kept = found.grid[seen], found.pixels[seen], found.sigma_px[seen]
        return BoardDetection(found.board_id, COLUMNS - 2, ROWS, *kept)

    for more in (0, 1):
        declared = replace(BOARDS[0], columns=COLUMNS + more)
        assert contradicted((covered[0], covered[1]), declared, left) == ()


def test_what_is_declared_and_seen_contradicts_nothing() -> None:
    assert contradicted(shown()[1], BOARDS[0]) == ()


def test_squares_that_go_on_beyond_the_declared_ones_fail() -> None:
    def first_columns(found: BoardDetection) -> BoardDetection:
        seen = found.grid[:, 0] < COLUMNS - 1
        kept = found.grid[seen], found.pixels[seen], found.sigma_px[seen]
        return BoardDetection(found.board_id, COLUMNS - 1, ROWS, *kept)

    (check,) = contradicted(shown()[1], replace(BOARDS[0], columns=COLUMNS - 1), first_columns)
    assert not check.passed and (check.measured, check.ours) == (COLUMNS - 1, COLUMNS)
    assert f"{COLUMNS} x {ROWS} inner corners or more" in check.how


def test_images_that_show_different_columns_of_a_larger_board_fail() -> None:
    """Taken for the same corners, they make the baseline a square longer or shorter."""
    scene, images = shown()
    declared = replace(BOARDS[0], columns=COLUMNS - 1)

    def columns_from(first: int, found: BoardDetection) -> list[BoardDetection]:
        seen = (found.grid[:, 0] >= first) & (found.grid[:, 0] < COLUMNS - 1 + first)
        grid = found.grid[seen] - np.array([first, 0])
        return [BoardDetection(found.board_id, COLUMNS - 1, ROWS, grid, found.pixels[seen], found.sigma_px[seen])]

    first, second = (columns_from(k, found[0]) for k, found in enumerate(scene.detections()))
    (check,) = contradicted_counts(match_pair("made", scene.camera1, scene.camera2, first, second, [declared]), images)
    assert (check.measured, check.ours) == (COLUMNS - 1, COLUMNS)


def test_what_is_left_may_lie_on_the_board_the_other_way_round() -> None:
    """Of a square part, the ends of the rows are no ends of columns."""
    ends, unknown = (BeyondCorners.ENDS, BeyondCorners.ENDS), (BeyondCorners.ENDS, BeyondCorners.UNKNOWN)
    square, upright = np.array([6, 6]), np.array([9, 4])
    assert _corners_shown(square, (9, 6), (unknown, ends)) == (9, 6)
    assert _corners_shown(square, (9, 6), (ends, unknown)) == (9, 6)
    assert _corners_shown(square, (9, 6), (ends, ends)) == (6, 6)
    assert _corners_shown(upright, (9, 6), (unknown, ends)) == (9, 4)
