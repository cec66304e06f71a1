"""Detection of whole boards, against the exact geometry of rendered scenes."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
import pytest
from helpers.detection_scenes import (
    corner_scene,
    dots,
    errors_by_position,
    fisheye,
    match,
    printed_text,
    regular,
    single,
)

from rigkit.core.boards import Board
from rigkit.core.detections import BoardDetection
from rigkit.core.errors import InputError
from rigkit.core.patterns.chessboard import Chessboard
from rigkit.detection.detect import detect_boards

RMS_PX = 0.008
"""Per axis, at blur 0.7 px and noise of 2 grey levels; the fit measures 0.006 and its own prediction is the same."""

WORST_FISHEYE_PX = 0.06
"""Outermost corners of a fisheye board; straight lines instead of curved ones would be off by ten times that."""

SIGMA_RATIO = (0.75, 1.25)
"""Actual over predicted error of 144 corners: 20 % asked, and 288 errors scatter by 4 %."""

STAIRCASE_PX = 0.1
"""Steps of a pixel, averaged over the few that each edge of a window has."""

SAME_PX = 0.02
"""One scene with other bits or colours: only quantisation and noise differ."""


@pytest.mark.parametrize("lens", ["regular", "fisheye"])
def test_three_perpendicular_boards(lens: str, rng: np.random.Generator) -> None:
    camera, distance = (regular(), 1250.0) if lens == "regular" else (fisheye(), 480.0)
    scene = corner_scene(rng, camera, distance)
    found = detect_boards(scene.image(rng))
    assert [(d.columns, d.rows, d.complete) for d in found] == [(8, 6, True)] * 3
    truth = scene.truth()
    matched = match(found, truth)
    assert len({id(d) for d in matched}) == 3
    errors = np.concatenate([errors_by_position(d, pixels) for d, (_, pixels) in zip(matched, truth, strict=True)])
    assert np.sqrt((errors**2).mean()) < RMS_PX
    assert np.linalg.norm(errors, axis=1).max() < WORST_FISHEYE_PX
    predicted = np.concatenate([d.sigma_px for d in matched])
    ratio = np.sqrt(((errors / predicted[:, None]) ** 2).mean())
    assert SIGMA_RATIO[0] < ratio < SIGMA_RATIO[1]


@pytest.mark.parametrize("noise, blur, bound", [(0.0, 0.3, 0.003), (5.0, 0.7, 0.018), (10.0, 2.0, 0.075)])
def test_accuracy_and_sigma_over_noise_and_blur(
    noise: float, blur: float, bound: float, rng: np.random.Generator
) -> None:
    scene = single(Board("b", 10, 10, 30.0, 30.0), [0.3, -0.25, 0.4], 600.0)
    (found,) = detect_boards(scene.image(rng, blur_px=blur, noise_levels=noise))
    assert found.complete
    errors = errors_by_position(found, scene.truth()[0][1])
    assert np.sqrt((errors**2).mean()) < bound
    if noise > 0.0:
        assert SIGMA_RATIO[0] < np.sqrt(((errors / found.sigma_px[:, None]) ** 2).mean()) < SIGMA_RATIO[1]


@pytest.mark.parametrize("quarter", range(4))
def test_odd_board_keeps_its_first_corner_however_it_is_turned(quarter: int, rng: np.random.Generator) -> None:
    """9x6: only one corner has a black square outside. Index by index against the geometry, so mirrors fail too."""
    board = Board("a", 9, 6, 30.0, 30.0)
    scene = single(board, [0.2, 0.15, 0.3 + quarter * np.pi / 2.0], 620.0)
    (found,) = detect_boards(scene.image(rng), [board])
    assert found.board_id == "a"
    assert np.array_equal(found.grid, board.grid())
    assert np.abs(found.pixels - scene.truth()[0][1]).max() < 0.1


@pytest.mark.parametrize("columns, rows", [(6, 9), (9, 6)])
def test_known_size_sets_columns_and_rows(columns: int, rows: int, rng: np.random.Generator) -> None:
    board = Board("a", columns, rows, 30.0, 30.0)
    scene = single(board, [0.2, 0.15, 0.3], 620.0)
    (found,) = detect_boards(scene.image(rng), [board])
    assert (found.columns, found.rows) == (columns, rows)
    assert np.abs(found.pixels - scene.truth()[0][1]).max() < 0.1
    (unknown,) = detect_boards(scene.image(rng))
    assert (unknown.columns, unknown.rows, unknown.board_id) == (9, 6, None)


@pytest.mark.parametrize("columns, rows", [(8, 6), (7, 7), (6, 6)])
def test_symmetric_board_is_right_up_to_its_own_symmetry(columns: int, rows: int, rng: np.random.Generator) -> None:
    board = Board("a", columns, rows, 30.0, 30.0)
    scene = single(board, [0.2, 0.15, 2.0], 500.0)
    (found,) = detect_boards(scene.image(rng), [board])
    truth = scene.truth()[0][1]
    hits = [q for q in range(4) if _agrees(found.turned(q), board, truth)]
    assert len(hits) == 1
    # 90 degrees would put a white square outside the first corner of an odd board, and swap the sides of an oblong.
    assert hits[0] in ((0, 2) if columns != rows or columns % 2 else (0, 1, 2, 3))


def _agrees(found: BoardDetection, board: Board, truth: np.ndarray) -> bool:
    same = np.array_equal(found.grid, board.grid())
    return same and bool(np.abs(found.pixels - truth).max() < 0.1)


def test_not_named_where_two_boards_have_the_size(rng: np.random.Generator) -> None:
    boards = [Board("a", 9, 6, 30.0, 30.0), Board("b", 6, 9, 20.0, 20.0)]
    (found,) = detect_boards(single(boards[0], [0.2, 0.1, 0.0], 620.0).image(rng), boards)
    assert found.board_id is None


def test_a_whole_board_is_named_beside_a_patch_of_its_size() -> None:
    squares = np.indices((7, 10)).sum(axis=0) % 2
    board = np.pad(np.kron(40.0 + 160.0 * squares, np.ones((30, 30))), 30, constant_values=220.0)
    patch = board.copy()
    patch[100:160, 100:200] = 130.0
    for beside, names in ((patch, ["only", None]), (board, [None, None])):
        image = np.rint(cv2.GaussianBlur(np.hstack([board, beside]), (0, 0), 1.0)).astype(np.uint8)
        found = detect_boards(image, [Board("only", 9, 6, 30.0, 30.0)])
        assert [(item.columns, item.rows, item.board_id) for item in found] == [(9, 6, name) for name in names]


def test_smallest_board_is_found_where_it_is_known(rng: np.random.Generator) -> None:
    board = Board("a", 3, 3, 60.0, 60.0)
    scene = single(board, [0.2, 0.15, 0.3], 620.0)
    image = scene.image(rng)
    assert detect_boards(image) == ()
    (found,) = detect_boards(image, [board])
    assert found.complete and found.board_id == "a"
    assert np.abs(errors_by_position(found, scene.truth()[0][1])).max() < 0.1


def test_board_cut_by_the_frame_keeps_what_is_in_view(rng: np.random.Generator) -> None:
    scene = single(Board("a", 9, 6, 30.0, 30.0), [0.2, 0.25, 0.1], 480.0, shift_mm=(150.0, 0.0))
    truth = scene.truth()[0][1]
    assert len(truth) < 54
    (found,) = detect_boards(scene.image(rng), [Board("a", 9, 6, 30.0, 30.0)])
    assert len(found.grid) >= len(truth) - 6
    assert np.linalg.norm(errors_by_position(found, truth), axis=1).max() < 0.1


def test_ruler_across_a_board_leaves_one_board_with_a_gap(rng: np.random.Generator) -> None:
    scene = single(Board("a", 9, 6, 30.0, 30.0), [0.2, 0.25, 0.1], 600.0)
    image = scene.image(rng)
    middle = image.shape[0] // 2
    cv2.fillConvexPoly(
        image, np.array([[0, middle - 70], [639, middle + 40], [639, middle + 62], [0, middle - 48]]), 180
    )
    (found,) = detect_boards(image)
    assert (found.columns, found.rows) == (9, 6)
    assert 35 < len(found.grid) < 54
    off = np.linalg.norm(found.pixels - scene.truth()[0][1][found.grid[:, 1] * 9 + found.grid[:, 0]], axis=1)
    assert np.quantile(off, 0.8) < 0.1, "rows beyond the ruler have the wrong index"


@pytest.mark.parametrize("margin", [0.0, 0.1])
def test_boards_that_touch_are_parted_at_the_seam(margin: float, rng: np.random.Generator) -> None:
    scene = corner_scene(rng, regular(), 1250.0, margin_squares=margin, clearance=0.0)
    found = detect_boards(scene.image(rng, blur_px=0.5))
    assert [(d.columns, d.rows, d.complete) for d in found] == [(8, 6, True)] * 3


def test_squares_of_six_pixels(rng: np.random.Generator) -> None:
    scene = single(Board("a", 9, 6, 30.0, 30.0), [0.1, 0.15, 0.3], 545.0 * 30.0 / 6.0)
    (found,) = detect_boards(scene.image(rng, blur_px=0.5))
    assert found.complete
    assert np.sqrt((errors_by_position(found, scene.truth()[0][1]) ** 2).mean()) < 0.03


def test_foreshortened_by_75_degrees(rng: np.random.Generator) -> None:
    scene = single(Board("a", 9, 6, 30.0, 30.0), [0.0, np.radians(75.0), 0.0], 430.0)
    (found,) = detect_boards(scene.image(rng, blur_px=0.5))
    assert found.complete


@pytest.mark.parametrize("change", [{"exposure": 0.025, "noise_levels": 0.3}, {"jpeg_quality": 60}, {"exposure": 1.6}])
def test_light_and_compression(change: dict[str, Any], rng: np.random.Generator) -> None:
    scene = single(Board("a", 9, 6, 30.0, 30.0), [0.3, 0.2, 0.1], 600.0)
    (found,) = detect_boards(scene.image(rng, **change))
    assert found.complete
    assert np.sqrt((errors_by_position(found, scene.truth()[0][1]) ** 2).mean()) < 0.06


def test_black_and_white_without_any_grey(rng: np.random.Generator) -> None:
    """A thresholded scan: every edge is a staircase, which no blur explains."""
    scene = single(Board("a", 9, 6, 30.0, 30.0), [0.1, 0.05, 0.06], 600.0)
    image = np.where(scene.image(rng, noise_levels=0.0) > 110, 255, 0).astype(np.uint8)
    (found,) = detect_boards(image)
    assert found.complete
    assert np.sqrt((errors_by_position(found, scene.truth()[0][1]) ** 2).mean()) < STAIRCASE_PX


def test_bits_and_colours_do_not_matter() -> None:
    scene = single(Board("a", 9, 6, 30.0, 30.0), [0.3, 0.2, 0.1], 600.0)
    grey = scene.image(np.random.default_rng(1), noise_levels=0.5)
    deep = scene.image(np.random.default_rng(1), noise_levels=0.5, bits=16)
    (expected,) = detect_boards(grey)
    for image in (deep, deep // 16, np.repeat(grey[..., None], 3, axis=2), grey.astype(np.float32)):
        (found,) = detect_boards(image)
        assert np.array_equal(found.grid, expected.grid)
        assert np.abs(found.pixels - expected.pixels).max() < SAME_PX


@pytest.mark.parametrize("dtype", [">u2", ">f4", ">f8"])
def test_byte_order_does_not_matter(dtype: str) -> None:
    image = single(Board("a", 9, 6, 30.0, 30.0), [0.3, 0.2, 0.1], 600.0).image(np.random.default_rng(1), bits=16)
    (expected,) = detect_boards(image.astype(dtype[1:]))
    (found,) = detect_boards(image.astype(dtype))
    assert np.array_equal(found.pixels, expected.pixels)


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf, 1e300])
def test_what_is_no_number_hides_no_more_than_itself(value: float, rng: np.random.Generator) -> None:
    scene = single(Board("a", 9, 6, 30.0, 30.0), [0.3, 0.2, 0.1], 600.0)
    image = scene.image(rng).astype(np.float64)
    image[230:236, 300:306] = value
    image[rng.random(image.shape) < 0.001] = value
    (found,) = detect_boards(image)
    assert len(found.grid) >= 48
    assert np.abs(errors_by_position(found, scene.truth()[0][1])).max() < 0.1
    assert detect_boards(np.full((100, 100), value)) == ()


def test_same_answer_twice_and_the_image_unchanged(rng: np.random.Generator) -> None:
    image = corner_scene(rng, regular(), 1250.0).image(rng)
    before = image.copy()
    first, second = detect_boards(image), detect_boards(image)
    assert np.array_equal(image, before)
    for one, two in zip(first, second, strict=True):
        assert np.array_equal(one.pixels, two.pixels)
        assert np.array_equal(one.sigma_px, two.sigma_px)


def _no_boards() -> dict[str, np.ndarray]:
    rng = np.random.default_rng(0)
    row, column = np.arange(300) // 24 % 2, np.arange(400) // 24 % 2
    cloth = (120 + 50 * row[:, None] + 50 * column).astype(np.uint8)
    tiles = np.full((300, 400), 60, np.uint8)
    for v in range(0, 300, 40):
        for u in range(0, 400, 40):
            cv2.rectangle(tiles, (u + 2, v + 2), (u + 37, v + 37), 180, -1)
    triangles = np.full((300, 400), 230, np.uint8)
    for v in range(0, 300, 30):
        for u in range(0, 400, 34):
            cv2.fillConvexPoly(triangles, np.array([[u, v], [u + 34, v], [u + 17, v + 30]]), 30, cv2.LINE_AA)
    return {
        "noise": (rng.random((300, 400)) * 255).astype(np.uint8),
        "text": printed_text(),
        "dots": dots((400, 300), 9),
        "large dots": dots((800, 600), 11),
        "gingham cloth": cv2.GaussianBlur(cloth, (0, 0), 0.8),
        "tiles": tiles,
        "triangles": triangles,
        "stripes": np.tile((np.arange(400) // 20 % 2 * 150 + 50).astype(np.uint8), (300, 1)),
        "black": np.zeros((300, 400), np.uint8),
    }


@pytest.mark.parametrize("name", list(_no_boards()))
def test_no_board_where_there_is_none(name: str) -> None:
    assert detect_boards(_no_boards()[name]) == ()


def test_corner_exactly_between_pixels_counts_once() -> None:
    """Symmetric pixels make two equal maxima a corner; they once broke every link of such a board."""
    board = (((np.arange(240) // 24)[:, None] + np.arange(312) // 24) % 2 * 170 + 40).astype(np.uint8)
    (found,) = detect_boards(cv2.GaussianBlur(board, (0, 0), 0.8))
    assert found.complete
    assert np.abs(found.pixels - np.round(found.pixels + 0.5) + 0.5).max() < 0.01


def test_a_board_that_nothing_looks_for_is_told_rather_than_never_found() -> None:
    class Stars(Chessboard):
        type = "stars"

    board = Board("a", 8, 6, 50.0, 50.0, pattern=Stars())
    with pytest.raises(InputError, match=r"board 'a': images cannot be searched for boards of type 'stars'.*registry"):
        detect_boards(np.zeros((60, 80), np.uint8), [board])


@pytest.mark.parametrize("boards", ["8x6x50", ["8x6x50"], Board("a", 8, 6, 50.0, 50.0)])
def test_boards_in_words_are_told_how_to_become_boards(boards: Any) -> None:
    with pytest.raises(InputError, match=r"list of rigkit.Board; rigkit.board_of_words makes"):
        detect_boards(np.zeros((60, 80), np.uint8), boards)


@pytest.mark.parametrize("image", [np.zeros((4, 100, 100)), np.zeros((100, 100), np.int32), np.zeros((8, 8), np.uint8)])
def test_what_is_no_image_is_refused(image: np.ndarray) -> None:
    with pytest.raises(InputError, match="image:"):
        detect_boards(image)
