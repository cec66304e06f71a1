"""AprilGrids: every tag by its number, corners as accurate as those of chessboards."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
from detection_bench.corner_bound import position_bound
from detection_bench.scenes import BenchScene, bench_camera, one_board, three_boards
from detection_bench.tag_bound import tag_information
from detectors.degradations import degraded
from helpers.detection_scenes import errors_by_place

from rigkit.core.boards import Board
from rigkit.core.errors import InputError
from rigkit.core.patterns.aprilgrid import TAG_FAMILIES, AprilGrid
from rigkit.detection.detect import detect_boards
from rigkit.geometry.rigid3 import Rigid3
from rigkit.synthetic.photometry import Photometry
from rigkit.synthetic.render import Optics
from rigkit.synthetic.scene import Panel, PlacedBoard

KALIBR = Board("k", 10, 8, 60.0, 60.0, pattern=AprilGrid(0.3))

OPENCV_PX = 2.0
"""Contours of markers, in whole pixels; another tag would be off by tens."""


def facing(board: Board, square_px: float = 50.0) -> BenchScene:
    """Return a board that faces the camera, a little turned."""
    camera = bench_camera("regular")
    depth = camera.parameters[0] * board.square_x_mm / square_px
    middle = board.points().mean(axis=0)
    turn = cv2.Rodrigues(np.array([0.1, -0.05, 0.03]))[0]
    return BenchScene("f", (PlacedBoard(board, Rigid3(turn, [0.0, 0.0, depth] - turn @ middle)),), (), camera)


@pytest.mark.parametrize("family", sorted(TAG_FAMILIES))
def test_what_is_printed_is_what_opencv_reads(family: str) -> None:
    pattern = AprilGrid(0.4, family, 1, 3, "opencv", corner_squares=False)
    board = Board("o", 6, 4, 60.0, 60.0, pattern=pattern)
    image = facing(board).render(optics=Optics(0.5), photometry=Photometry())
    dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, TAG_FAMILIES[family]))
    corners, numbers, _ = cv2.aruco.ArucoDetector(dictionary).detectMarkers(image)
    assert sorted(numbers.ravel().tolist()) == [3, 4, 5, 6, 7, 8]
    truth = facing(board).truth()[0].lattice()
    for number, quad in zip(numbers.ravel(), corners, strict=True):
        row, column = np.argwhere(pattern.numbers(*board.size) == number)[0] * 2
        own = truth[[row, row, row + 1, row + 1], [column, column + 1, column + 1, column]]
        assert np.abs(quad.reshape(4, 2) - own).max() < OPENCV_PX


@pytest.mark.parametrize("lens", ["regular", "fisheye"])
@pytest.mark.parametrize(
    "pattern",
    [
        AprilGrid(0.3),
        AprilGrid(0.5, "tag25h9", first_tag=7),
        AprilGrid(0.25, "tag16h5", 1, numbering="opencv"),
        AprilGrid(0.3, corner_squares=False),
        AprilGrid(0.5, "tag25h9", 1, 7, "opencv", corner_squares=False),
    ],
    ids=["kalibr", "25h9", "16h5", "tags alone", "25h9 alone"],
)
def test_every_corner_has_its_own_number(lens: str, pattern: AprilGrid, rng: np.random.Generator) -> None:
    scene = one_board(rng, lens=lens, board=replace(KALIBR, pattern=pattern))
    (found,) = detect_boards(scene.render(noise_levels=2.0, rng=rng), [scene.boards[0].board])
    assert found.board_id == "k"
    assert len(found.grid) >= 78
    off = errors_by_place(found, scene.truth()[0])
    # At the rim of a fisheye, tags alone leave a few corners a quarter of a pixel open, and say so.
    assert (np.abs(off) < 5.0 * found.sigma_px[:, None]).all()
    assert np.sqrt((off**2).mean()) < (0.03 if pattern.corner_squares else 0.1)
    assert 0.7 < np.sqrt(((off / found.sigma_px[:, None]) ** 2).mean()) < 1.3


@pytest.mark.parametrize("squares", [True, False])
def test_tags_with_borders_narrower_than_windows_are_fitted_whole(squares: bool) -> None:
    """Modules of little more than a pixel, slanted at the rim of a fisheye, are as fine as information has it."""
    board = replace(KALIBR, pattern=AprilGrid(0.3, corner_squares=squares))
    squared, bounds, relative = 0.0, 0.0, []
    for seed in (1, 3):
        rng = np.random.default_rng(seed)
        scene = one_board(rng, lens="fisheye", board=board)
        (found,) = detect_boards(scene.render(noise_levels=2.0, rng=rng), [board])
        truth = scene.truth()[0]
        place = np.zeros((board.rows, board.columns), np.int64)
        place[truth.grid[:, 1], truth.grid[:, 0]] = np.arange(len(truth.grid))
        bound = np.trace(position_bound(tag_information(scene, 0.7), 2.0), axis1=1, axis2=2)
        bound = bound[place[found.grid[:, 1], found.grid[:, 0]]]
        off, known = errors_by_place(found, truth), np.isfinite(bound)
        squared, bounds = squared + (off[known] ** 2).sum(), bounds + bound[known].sum()
        relative.append(off / found.sigma_px[:, None])
    assert np.sqrt(squared / bounds) < 1.15
    assert 0.8 < np.sqrt((np.concatenate(relative) ** 2).mean()) < 1.3


@pytest.mark.parametrize(
    ("pattern", "seed"), [(AprilGrid(0.25, "tag16h5", 1, numbering="opencv"), 1), (AprilGrid(0.5, "tag25h9", 1), 111)]
)
def test_tags_at_the_rim_of_a_fisheye_are_read_where_the_others_have_them(pattern: AprilGrid, seed: int) -> None:
    """Their codes lie in the windows of their corners, which fit badly for that, but in the right places."""
    board, rng = replace(KALIBR, pattern=pattern), np.random.default_rng(seed)
    scene = one_board(rng, lens="fisheye", board=board)
    (found,) = detect_boards(scene.render(blur_px=0.7, noise_levels=2.0, rng=rng), [board])
    assert len(found.grid) == 80
    off = errors_by_place(found, scene.truth()[0])
    assert np.abs(off).max() < 0.15
    assert (np.abs(off) < 5.0 * found.sigma_px[:, None]).all()


def test_tags_with_narrow_gaps_are_fitted_whole_and_covered_corners_are_none() -> None:
    """Squares of 2.5 px between tags of 25 px: windows of single corners reach 1.3 px, and lost a third of them."""
    scene = facing(replace(KALIBR, pattern=AprilGrid(0.1)), 25.0)
    image = scene.render(blur_px=0.8, noise_levels=2.0, rng=np.random.default_rng(3))
    (whole,) = detect_boards(image, [scene.boards[0].board])
    truth = scene.truth()[0].lattice()
    assert whole.complete
    assert float(np.sqrt(np.mean(np.sum((whole.lattice() - truth) ** 2, axis=2)))) < 0.025
    noisy = scene.render(blur_px=0.8, noise_levels=8.0, rng=np.random.default_rng(3)).copy()
    for corner in (truth[1, 2], truth[5, 7]):
        cv2.circle(noisy, np.round(corner).astype(int).tolist(), 4, (90,), -1)
    (rest,) = detect_boards(noisy, [scene.boards[0].board])
    seen = np.isfinite(rest.lattice()[..., 0])
    assert seen.mean() > 0.8 and not seen[1, 2] and not seen[5, 7]


def test_tags_alone_with_narrow_borders_are_completed() -> None:
    """Corners that no first look finds are foretold by those around them."""
    board, rng = replace(KALIBR, pattern=AprilGrid(0.3, corner_squares=False)), np.random.default_rng(1)
    scene = one_board(rng, lens="fisheye", board=board)
    (found,) = detect_boards(scene.render(noise_levels=2.0, rng=rng), [board])
    assert len(found.grid) >= 78
    assert (np.abs(errors_by_place(found, scene.truth()[0])) < 5.0 * found.sigma_px[:, None]).all()


def test_two_boards_are_told_apart_by_their_tags(rng: np.random.Generator) -> None:
    boards = [Board(n, 6, 6, 60.0, 60.0, pattern=AprilGrid(0.3, first_tag=9 * k)) for k, n in enumerate("ab")]
    camera = bench_camera("regular")
    turn = np.diag([-1.0, -1.0, 1.0])
    left = PlacedBoard(boards[0], Rigid3(turn, np.array([-30.0, 100.0, 800.0])))
    right = PlacedBoard(boards[1], Rigid3(np.eye(3), np.array([50.0, -100.0, 800.0])))
    scene = BenchScene("two", (left, right), (), camera)
    found = {d.board_id: d for d in detect_boards(scene.render(noise_levels=2.0, rng=rng), boards[::-1])}
    assert set(found) == {"a", "b"}
    for truth in scene.truth():
        assert len(found[str(truth.board_id)].grid) == 36
        assert np.abs(errors_by_place(found[str(truth.board_id)], truth)).max() < 0.2


def test_coarse_corners_that_break_lattices_of_slanted_tags_do_not_count() -> None:
    board = Board("s", 12, 12, 88.0, 88.0, pattern=AprilGrid(0.3))
    turn = cv2.Rodrigues(np.radians([0.0, 70.0, 0.0]))[0]
    place = Rigid3(turn, np.array([0.0, 0.0, 1550.0]) - turn @ board.points().mean(axis=0))
    scene = BenchScene("s", (PlacedBoard(board, place),), (), bench_camera("regular"))
    (found,) = detect_boards(scene.render(noise_levels=2.0, rng=np.random.default_rng(0)), [board])
    # Of the narrowest column, tags have sides of 7 px.
    assert found.board_id == "s" and len(found.grid) > 100
    assert np.sqrt((errors_by_place(found, scene.truth()[0]) ** 2).mean()) < 0.02


def test_a_part_keeps_its_numbers(rng: np.random.Generator) -> None:
    scene = facing(KALIBR, 75.0)
    cover = Panel(scene.boards[0].world_from_board @ Rigid3(np.eye(3), np.array([170.0, 90.0, -2.0])), 60.0, 400.0, 0.4)
    scene = replace(scene, occluders=(cover,))
    (found,) = detect_boards(scene.render(noise_levels=2.0, rng=rng), [KALIBR])
    off = np.linalg.norm(errors_by_place(found, scene.truth()[0]), axis=1)
    assert 30 < len(off) < 72
    assert np.median(off) < 0.05
    assert off.max() < 0.5


@pytest.mark.parametrize("turns", range(4))
def test_blurred_tags_are_read_together(turns: int, rng: np.random.Generator) -> None:
    """Modules of 2.5 px under a blur of 2.5 px: hardly a tag is read by itself; together they have one place."""
    image = np.rot90(facing(KALIBR, 25.0).render(optics=Optics(2.5), noise_levels=2.0, rng=rng), turns)
    truth = facing(KALIBR, 25.0).truth()[0].pixels
    height, width = image.shape if turns % 2 == 0 else image.shape[::-1]
    for _ in range(turns):
        truth, (height, width) = np.stack([truth[:, 1], width - 1.0 - truth[:, 0]], axis=1), (width, height)
    (found,) = detect_boards(np.ascontiguousarray(image), [KALIBR])
    assert found.board_id == "k" and len(found.grid) >= 78
    off = found.pixels - truth[found.grid[:, 1] * KALIBR.columns + found.grid[:, 0]]
    assert np.abs(off).max() < 1.0


def test_corners_of_blurred_tags_that_lack_one_are_fitted_with_the_whole_tag() -> None:
    """Left to windows full of code, they were off by up to .95 px: .18 px in the mean, 1.5 of their sigmas."""
    board = replace(KALIBR, columns=12, rows=12)
    scene = one_board(np.random.default_rng(72), board=board)
    (found,) = detect_boards(scene.render(blur_px=3.0, noise_levels=2.0, rng=np.random.default_rng(2)), [board])
    error = errors_by_place(found, scene.truth()[0])
    assert 100 < len(found.grid) < 144
    assert np.sqrt((error**2).mean()) < 0.08
    assert 0.7 < np.sqrt(((error / found.sigma_px[:, None]) ** 2).mean()) < 1.3


def test_blurred_tags_of_another_board_are_none(rng: np.random.Generator) -> None:
    image = facing(KALIBR, 25.0).render(optics=Optics(2.5), noise_levels=2.0, rng=rng)
    others = replace(KALIBR, board_id="o", pattern=AprilGrid(0.3, first_tag=100))
    assert not any(found.board_id for found in detect_boards(image, [others]))


@pytest.mark.parametrize(("shown", "declared"), [(1.0, 4), (0.5, 4), (0.5, 6), (0.5, 10), (0.5, 12)])
def test_tags_of_a_board_with_other_columns_are_none(shown: float, declared: int) -> None:
    """Of the whole board one row agrees with the declared board's; of its half one tag is read, by chance."""
    board = Board("b", 12, 12, 60.0, 60.0, pattern=AprilGrid(0.3))
    image = facing(board, 30.0).render(optics=Optics(2.5), noise_levels=2.0, rng=np.random.default_rng(0))
    part = np.ascontiguousarray(image[:, : round(shown * image.shape[1])])
    found = detect_boards(part, [replace(board, columns=declared)])
    assert [item.board_id for item in found] == (["b"] if declared == board.columns else [])


def test_tags_of_few_bits_name_no_mirror_image() -> None:
    """Of the nine in the lattice eight are read as some tag of the board, four of them as those of one place."""
    tags = AprilGrid(0.3, "DICT_APRILTAG_16h5", numbering="opencv")
    board, rng = Board("m", 6, 6, 40.0, 40.0, pattern=tags), np.random.default_rng(0)
    beside = Board("n", 6, 4, 40.0, 40.0, pattern=replace(tags, first_tag=9))
    small = Board("o", 4, 4, 40.0, 40.0, pattern=replace(tags, first_tag=15))
    scene = three_boards(rng, boards=[board, beside, small], lens="fisheye", size_px=(960, 720))
    image = scene.render(blur_px=0.8, noise_levels=2.0, rng=rng)
    assert {item.board_id for item in detect_boards(image, [board])} == {"m"}
    assert not any(item.board_id for item in detect_boards(np.ascontiguousarray(image[:, ::-1]), [board]))


def test_tags_of_another_board_are_none(rng: np.random.Generator) -> None:
    image = facing(KALIBR).render(noise_levels=2.0, rng=rng)
    others = [AprilGrid(0.3, first_tag=100), AprilGrid(0.3, "tag36h10")]
    boards = [replace(KALIBR, board_id=f"n{k}", pattern=pattern) for k, pattern in enumerate(others)]
    assert detect_boards(image, boards) == ()


@pytest.mark.parametrize(
    "pattern", [{"border": 3}, {"first_tag": 580}, {"family": "tag7h1"}, {"numbering": "left"}, {"spacing": 0.0}]
)
def test_tags_that_cannot_be_are_refused(pattern: dict[str, object]) -> None:
    family = ".*OpenCV has tag36h11, tag36h10, tag25h9, tag16h5" if "family" in pattern else ""
    with pytest.raises(InputError, match=f"board 'k'{family}"):
        replace(KALIBR, pattern=AprilGrid(**{"spacing": 0.3, **pattern}))  # type: ignore[arg-type]


@pytest.mark.parametrize("squares", [True, False])
def test_white_tags_are_found_where_black_ones_are_in_the_negative(squares: bool, rng: np.random.Generator) -> None:
    pattern = AprilGrid(0.3, corner_squares=squares)
    black = Board("b", 8, 6, 60.0, 60.0, pattern=pattern)
    white = replace(black, pattern=replace(pattern, inverted=True))
    scene = facing(white)
    image = np.asarray(scene.render(optics=Optics(0.5), noise_levels=2.0, rng=rng), np.uint8)
    (found,) = detect_boards(image, [white])
    assert found.complete and found.board_id == "b"
    (negative,) = detect_boards(255 - image, [black])
    np.testing.assert_array_equal(found.pixels, negative.pixels)
    assert np.sqrt((errors_by_place(found, scene.truth()[0]) ** 2).sum(axis=1).mean()) < 0.05
    assert detect_boards(image, [black]) == ()


def test_tags_of_a_hundredth_of_an_images_brightness(rng: np.random.Generator) -> None:
    """A heat image: what is hot beside the board takes nearly all of its 16 bits."""
    scene = facing(KALIBR)
    clear = scene.render(optics=Optics(0.8), noise_levels=1.0, rng=rng).astype(np.float64)
    heat = 7000.0 + 0.4 * clear
    heat[:40, :60] = 14000.0
    (found,) = detect_boards(np.rint(heat).astype(np.uint16), [KALIBR])
    assert found.complete and found.board_id == "k"
    z = errors_by_place(found, scene.truth()[0]) / found.sigma_px[:, None]
    assert 0.7 < np.sqrt((z**2).mean()) < 1.4


def test_tags_that_light_parts_from_the_squares_between_them_are_sought_alone() -> None:
    """Of the saddles a few are left, which say that it is this board."""
    board, rng = Board("grid", 8, 8, 60.0, 60.0, pattern=AprilGrid(0.3)), np.random.default_rng(0)
    scene = one_board(rng, board=board, size_px=(1280, 960))
    clear = np.asarray(scene.render(blur_px=0.6, noise_levels=2.0, rng=rng), np.uint8)
    image, _ = degraded("run over", 2.0, clear, rng)
    (found,) = detect_boards(image, [board])
    assert len(found.grid) == 64
    off = found.pixels - scene.truth()[0].lattice()[found.grid[:, 1], found.grid[:, 0]]
    assert np.sqrt(np.mean(off**2)) < 0.15


def test_tags_without_squares_between_them_are_no_board_with_squares(rng: np.random.Generator) -> None:
    board = Board("grid", 8, 8, 60.0, 60.0, pattern=AprilGrid(0.3, corner_squares=False))
    image = one_board(rng, board=board).render(noise_levels=2.0, rng=rng)
    assert detect_boards(image, [board])
    assert not detect_boards(image, [replace(board, pattern=AprilGrid(0.3))])


@pytest.mark.parametrize("lens", ["regular", "fisheye"])
def test_tags_of_twelve_pixels_are_found(lens: str) -> None:
    """The squares between them are 3 to 4 px wide, less than the ring of a corner."""
    rng = np.random.default_rng(2)
    scene = one_board(rng, lens=lens, board=KALIBR, max_tilt_deg=30.0, square_px=11.0)
    (found,) = detect_boards(scene.render(optics=Optics(0.6), noise_levels=2.0, rng=rng), [KALIBR])
    assert len(found.grid) > 0.9 * KALIBR.corner_count
    assert np.abs(errors_by_place(found, scene.truth()[0])).max() < 0.25


def test_strips_too_narrow_for_coarser_levels_show_none() -> None:
    assert not detect_boards(np.zeros((200, 16), np.uint8), [KALIBR])
