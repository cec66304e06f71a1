"""Circle grids: found and named, centres without the bias of slant and lens, close to the Cramer-Rao bound."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
from detection_bench.circle_bound import circle_information
from detection_bench.corner_bound import position_bound
from detection_bench.scenes import BENCH_PHOTOMETRY, BenchScene, bench_camera, bench_field_deg, one_board
from detectors.degradations import degraded
from helpers.data import read_grey, shared_data
from helpers.detection_scenes import errors_by_place

from rigkit.core.boards import Board
from rigkit.core.errors import InputError
from rigkit.core.patterns.circles import Circles
from rigkit.detection.circles.search import find_grids
from rigkit.detection.detect import detect_boards
from rigkit.detection.saddles.response import grey_image
from rigkit.geometry.rigid3 import Rigid3
from rigkit.geometry.rotation import exp_so3
from rigkit.io.boards.board_words import board_of_words
from rigkit.synthetic.photometry import Photometry, develop
from rigkit.synthetic.render import Optics
from rigkit.synthetic.scene import Panel, PlacedBoard

REGULAR = Board("r", 10, 8, 25.0, 25.0, pattern=Circles(diameter_mm=15.0))
ASYMMETRIC = Board("a", 4, 11, 40.0, 40.0, pattern=Circles("asymmetric", diameter_mm=16.0))
HEXAGONAL = Board("h", 12, 9, 20.0, 20.0, pattern=Circles("hexagonal", diameter_mm=15.0))
LEFT = Board("l", 12, 8, 20.0, 20.0, pattern=Circles("hexagonal", "left", diameter_mm=15.0))
WHITE = Board("w", 4, 11, 40.0, 40.0, pattern=Circles("asymmetric", diameter_mm=16.0, inverted=True))
BOARDS = [REGULAR, ASYMMETRIC, HEXAGONAL, LEFT, WHITE]

MAX_BIAS_PX = 0.01
"""Of the centres of a slanted grid without noise, in the mean."""
HONEST = (0.8, 1.25)
"""RMS error over predicted standard deviation."""
HONEST_UNDER_GLARE = (0.5, 2.4)
"""The same: measured 0.6 to 2.2, most for small circles, whose moves noise hides; 2.7 to 5.6 without added light."""
MAX_BOUND = 1.15
"""RMS error over the Cramer-Rao bound, which knows the map's curvature; at the rim of a board that fills a fisheye the
whole board tells it (1.09 of twelve; by a perspective and a polynomial alone 1.23, by neighbours 1.35)."""
SINGLE_PX = 0.12
"""A rim circle of a grid seen by a fisheye at 60 degrees from near by: its neighbours lie on one side."""
MOVED_PX = 0.015
"""Of circles that motion of 6 px joins: measured 0.007 to 0.010, and 0.14 with one blur for all directions."""
MIXED_PX = 0.04
"""Of tight circles, their gaps 2.7 px, that motion of 8 px mixes: measured 0.018; none was found before."""
QUICK_PX = 0.3
"""What a quick look may be off, by the maps of blobs: measured 0.07 px."""


NOISY = replace(BENCH_PHOTOMETRY, noise_levels=2.0)


def slanted(board: Board, lens: str, off_deg: float, slant_deg: float, distance_mm: float) -> BenchScene:
    """Return a scene of one board whose middle lies off the axis and which is slanted to the ray that it lies on."""
    camera = bench_camera(lens)
    off = exp_so3(np.radians(off_deg) * np.array([-0.35, 0.94, 0.0]))
    rotation = off @ exp_so3(np.radians(slant_deg) * np.array([0.6, 0.8, 0.0]))
    points = board.points()
    middle = 0.5 * (points.min(axis=0) + points.max(axis=0))
    place = Rigid3(rotation, off @ np.array([0.0, 0.0, distance_mm]) - rotation @ middle)
    return BenchScene(lens, (PlacedBoard(board, place),), (), camera, bench_field_deg(lens))


@pytest.mark.parametrize("board", BOARDS, ids=lambda board: board.board_id)
@pytest.mark.parametrize("lens", ["regular", "fisheye"])
def test_grids_are_found_whole_and_named_with_honest_sigmas(board: Board, lens: str) -> None:
    relative = []
    for seed in range(2):
        rng = np.random.default_rng(seed)
        scene = one_board(rng, lens=lens, board=board)
        (found,) = detect_boards(scene.render(noise_levels=2.0, rng=rng), [board])
        truth = scene.truth()[0]
        assert found.board_id == board.board_id
        assert found.complete
        turns = [found, *(found.turned(k) for k in board.turns)]
        tried = (errors_by_place(turn, truth) / turn.sigma_px[:, None] for turn in turns)
        relative.append(min(tried, key=lambda e: float(np.abs(e).max())))
    assert HONEST[0] < np.sqrt((np.concatenate(relative) ** 2).mean()) < HONEST[1]


def test_a_quick_look_sees_the_same_grid_nearly_where_it_is() -> None:
    rng = np.random.default_rng(3)
    image = one_board(rng, lens="regular", board=REGULAR).render(noise_levels=2.0, rng=rng)
    (whole,), (quick,) = (detect_boards(image, [REGULAR], quick=quick) for quick in (False, True))
    assert quick.board_id == REGULAR.board_id and quick.complete
    assert 0.0 < np.abs(quick.pixels - whole.pixels).max() < QUICK_PX


@pytest.mark.parametrize(
    ("lens", "off_deg", "slant_deg", "distance_mm"),
    [("regular", 20.0, 60.0, 500.0), ("fisheye", 60.0, 0.0, 300.0), ("fisheye", 60.0, 60.0, 350.0)],
)
@pytest.mark.parametrize("board", [REGULAR, HEXAGONAL], ids=["regular", "hexagonal"])
def test_the_centre_is_the_image_of_the_centre(
    board: Board, lens: str, off_deg: float, slant_deg: float, distance_mm: float
) -> None:
    scene = slanted(board, lens, off_deg, slant_deg, distance_mm)
    (found,) = find_grids(grey_image(scene.render(blur_px=0.7)))
    truth = scene.truth()[0].pixels
    nearest = np.linalg.norm(found.pixels[:, None] - truth, axis=2).argmin(axis=1)
    off = found.pixels - truth[nearest]
    assert len(found) > 0.7 * len(truth)
    assert np.abs(off.mean(axis=0)).max() < MAX_BIAS_PX
    assert np.sqrt(np.median(off**2)) < MAX_BIAS_PX
    assert np.abs(off).max() < SINGLE_PX


@pytest.mark.parametrize("board", [REGULAR, HEXAGONAL], ids=["regular", "hexagonal"])
def test_the_lens_tells_what_neighbours_do_not(board: Board) -> None:
    # Slanted and near: the map bends most at one rim.
    scene = one_board(np.random.default_rng(1), lens="fisheye", board=board)
    image, truth = scene.render(blur_px=0.7), scene.truth()[0]
    alone, known = (detect_boards(image, [board], camera=camera)[0] for camera in (None, scene.camera))
    off = []
    for found in (alone, known):
        turns = [found, *(found.turned(k) for k in board.turns)]
        off.append(min((errors_by_place(turn, truth) for turn in turns), key=lambda e: float(np.abs(e).max())))
    assert len(off[0]) == len(off[1]) == board.corner_count
    assert np.sqrt((off[1] ** 2).mean()) < np.sqrt((off[0] ** 2).mean())
    assert np.abs(off[1]).max() < 2.0 * MAX_BIAS_PX
    assert np.abs(off[1].mean(axis=0)).max() < 0.2 * MAX_BIAS_PX


def test_a_lens_that_did_not_see_the_board_is_not_asked() -> None:
    rng = np.random.default_rng(1)
    scene = one_board(rng, lens="fisheye", board=REGULAR)
    image = scene.render(noise_levels=2.0, rng=rng)
    (alone,), (wrong,) = (detect_boards(image, [REGULAR], camera=camera) for camera in (None, bench_camera("regular")))
    assert np.array_equal(alone.pixels, wrong.pixels)


def test_a_cut_grid_gets_its_place_where_its_borders_show() -> None:
    scene = slanted(ASYMMETRIC, "regular", 24.0, 20.0, 520.0)
    truth = scene.truth()[0]
    assert len(truth.grid) < ASYMMETRIC.corner_count
    (found,) = detect_boards(scene.render(), [ASYMMETRIC])
    assert found.board_id == "a"
    assert np.abs(errors_by_place(found, truth)).max() < SINGLE_PX


@pytest.mark.parametrize("turn_deg", [-65.0, -55.0, 55.0])
def test_a_board_whose_corner_is_cut_off_is_told_from_a_larger_one(turn_deg: float) -> None:
    small, large = (replace(REGULAR, board_id=f"of {n}", columns=n, rows=6) for n in (7, 8))
    turn = exp_so3(np.radians([20.0, 0.0, turn_deg]))
    place = Rigid3(turn, np.array([0.0, 0.0, 420.0]) - turn @ small.points().mean(axis=0))
    scene = BenchScene("regular", (PlacedBoard(small, place),), (), bench_camera("regular"), bench_field_deg("regular"))
    truth = scene.truth()[0]
    lowest = truth.pixels[:, 1].argmax()
    image = scene.render()[: int(truth.pixels[lowest, 1])]
    for boards in ([small, large], [large, small]):
        (found,) = detect_boards(image, boards)
        assert found.board_id == small.board_id
        assert len(found.grid) == small.corner_count - 1
        assert np.abs(errors_by_place(found, truth)).max() < SINGLE_PX


@pytest.mark.parametrize("pattern", [REGULAR.pattern, HEXAGONAL.pattern], ids=["regular", "hexagonal"])
def test_of_two_boards_that_the_image_cannot_tell_apart_none_is_named(pattern: Circles) -> None:
    """A row is beyond the image's border: what is left is the smaller board, or a part of the larger one."""
    small, large = (replace(REGULAR, board_id=f"of {n}", columns=7, rows=n, pattern=pattern) for n in (6, 7))
    turn = exp_so3(np.radians([5.0, 3.0, 2.0]))
    place = Rigid3(turn, np.array([0.0, 0.0, 420.0]) - turn @ large.points().mean(axis=0))
    scene = BenchScene("regular", (PlacedBoard(large, place),), (), bench_camera("regular"), bench_field_deg("regular"))
    rows = scene.truth()[0].lattice()[..., 1]
    image = scene.render()
    cut = image[: int(0.5 * (rows[-2].max() + rows[-1].min()))]
    assert [item.board_id for item in detect_boards(cut, [small, large])] == [None]
    assert [item.board_id for item in detect_boards(cut, [small])] == ["of 6"]
    assert [item.board_id for item in detect_boards(image, [small, large])] == ["of 7"]


@pytest.mark.parametrize("board", [REGULAR, HEXAGONAL], ids=lambda board: board.board_id)
def test_edges_that_too_much_light_leaves_without_blur_are_edges(board: Board) -> None:
    """Paper that is cut off at white takes the upper half of every edge along: what is left is a step from pixel to
    pixel, sharper than any lens makes."""
    scene = one_board(np.random.default_rng(1), board=board, size_px=(800, 600))
    image = scene.render(optics=Optics(0.4), photometry=NOISY, rng=np.random.default_rng(1))
    white = float(np.quantile(image, 0.9))
    lit = np.clip(2.0 * 255.0 / white * image.astype(np.float64), 0.0, 255.0).astype(np.uint8)
    (found,) = detect_boards(lit, [board])
    assert found.board_id == board.board_id
    assert len(found.grid) == board.rows * board.columns


def errors_of_moved(seed: int, diameter_mm: float, motion_px: float) -> tuple[float, float]:
    """Return the rms error of all circles of a board under motion blur, in px and in sigmas."""
    rng = np.random.default_rng(seed)
    board = replace(HEXAGONAL, pattern=Circles("hexagonal", diameter_mm=diameter_mm))
    scene = one_board(rng, board=board)
    clear = np.asarray(scene.render(optics=Optics(0.5), photometry=NOISY, rng=rng), np.uint8)
    (found,) = detect_boards(degraded("motion", motion_px, clear, rng)[0], [board])
    assert found.complete
    error = errors_by_place(found, scene.truth()[0])
    return np.sqrt((error**2).mean()), np.sqrt(((error / found.sigma_px[:, None]) ** 2).mean())


@pytest.mark.parametrize("light", [replace(NOISY, gamma=2.2), replace(NOISY, exposure=1.8)], ids=["gamma", "saturated"])
def test_edges_that_a_tone_curve_moves_leave_centres_where_they_are(light: Photometry) -> None:
    """By the sizes of the edges as they are seen, errors are 2.3 and 1.7 sigmas."""
    relative = []
    for seed in (1, 3):
        rng = np.random.default_rng(seed)
        scene = one_board(rng, lens="fisheye", board=REGULAR)
        (found,) = detect_boards(scene.render(photometry=light, rng=rng), [REGULAR])
        assert found.complete
        truth = scene.truth()[0]
        off = min((errors_by_place(found, t) for t in (truth, truth.turned(2))), key=lambda each: np.abs(each).max())
        relative.append(off / found.sigma_px[:, None])
    assert np.sqrt((np.concatenate(relative) ** 2).mean()) < HONEST[1]


def test_circles_that_are_all_as_large_are_printed_as_they_are_seen() -> None:
    """Their sizes do not tell how far light or ink moves their edges: the errors of distances would give 0.25."""
    scene = slanted(Board("b", 28, 20, 25.0, 25.0, pattern=Circles(diameter_mm=15.0)), "regular", 0.0, 0.0, 700.0)
    (found,) = find_grids(grey_image(scene.render(noise_levels=2.0, rng=np.random.default_rng(1))))
    assert found.radius == pytest.approx(0.3, rel=0.03)


def test_circles_whose_light_a_motion_mixes_are_where_they_are() -> None:
    """With one blur for all directions four of 108 fitted no more, and the others were off by 2 of their sigmas."""
    error_px, in_sigmas = errors_of_moved(1, 16.7, 6.0)
    assert error_px < MOVED_PX and HONEST[0] < in_sigmas < HONEST[1]


def test_circles_are_found_that_motion_lets_no_fit_tell_apart() -> None:
    """No fit settles without the neighbours' light, and none without pixels in the corners of cells, where paper is."""
    error_px, in_sigmas = errors_of_moved(2, 17.5, 8.0)
    assert error_px < MIXED_PX and in_sigmas < HONEST[1]


def test_circles_that_something_covers_are_left_out() -> None:
    rng = np.random.default_rng(3)
    scene = one_board(rng, lens="regular", board=HEXAGONAL)
    place = scene.boards[0].world_from_board
    middle = HEXAGONAL.points().mean(axis=0) - np.array([0.0, 0.0, 2.0])
    bar = Panel(Rigid3(place.rotation, place.apply(middle[None])[0]), 50.0, 28.0, 0.4)
    scene = replace(scene, occluders=(bar,))
    (found,) = detect_boards(scene.render(noise_levels=2.0, rng=rng), [HEXAGONAL])
    truth, clear = scene.truth()[0], scene.clear()[0]
    assert found.board_id == "h"
    assert clear.sum() - 8 <= len(found.grid) < len(truth.grid)
    assert np.abs(errors_by_place(found, truth)).max() < SINGLE_PX


def test_a_faint_grid_in_noise_is_found() -> None:
    """A quarter of its contrast is noise, which does not count as a residual of the circles."""
    rng = np.random.default_rng(2)
    scene = one_board(rng, lens="regular", board=REGULAR)
    image = scene.render(rng=rng).astype(np.float64)
    faint = 120.0 + 0.045 * (image - 128.0) + 2.0 * rng.standard_normal(image.shape)
    (found,) = detect_boards(np.rint(faint).astype(np.uint8), [REGULAR])
    assert found.complete and found.board_id == "r"
    turns = [found, *(found.turned(k) for k in REGULAR.turns)]
    assert min(np.abs(errors_by_place(turn, scene.truth()[0])).max() for turn in turns) < 0.5


def test_something_round_beside_a_grid_is_not_of_the_board() -> None:
    scene = slanted(HEXAGONAL, "regular", 0.0, 20.0, 450.0)
    points, pose = HEXAGONAL.points(), scene.boards[0].world_from_board
    angles = np.arange(40) * np.pi / 20.0
    ring = 7.5 * np.stack([np.cos(angles), np.sin(angles), np.zeros(40)], axis=-1)
    # Before the fourth row, in its step.
    ring += points[3 * HEXAGONAL.columns] - (points[1] - points[0])
    seen = scene.camera.project(pose.apply(ring))[0]
    image = scene.render(noise_levels=2.0, rng=np.random.default_rng(0)).astype(np.uint8)
    cv2.fillPoly(image, [np.rint(16.0 * seen).astype(np.int32)], 40, cv2.LINE_AA, 4)
    assert [len(grid) for grid in find_grids(image)] == [HEXAGONAL.corner_count + 1]
    (found,) = detect_boards(image, [HEXAGONAL])
    assert found.board_id == "h" and found.complete
    assert np.abs(errors_by_place(found, scene.truth()[0])).max() < SINGLE_PX


@pytest.mark.parametrize("motion_px", [(2.6, 1.5), (5.2, 3.0)])
def test_a_motion_that_stretches_all_circles_alike_makes_none_uncertain(motion_px: tuple[float, float]) -> None:
    """It is the same on both sides of a circle: taken for noise, sigmas are 2.4 and 5 times the errors, and for errors
    of the map 3.9 and 11 times."""
    rng = np.random.default_rng(1)
    scene = one_board(rng, board=REGULAR, size_px=(800, 600))
    image = scene.render(optics=Optics(0.7, motion_px=motion_px), photometry=NOISY, rng=rng)
    (found,) = detect_boards(image, [REGULAR])
    turns = [found, *(found.turned(k) for k in REGULAR.turns)]
    z = min(
        (errors_by_place(t, scene.truth()[0]) / t.sigma_px[:, None] for t in turns),
        key=lambda e: float(np.abs(e).max()),
    )
    assert HONEST[0] < np.sqrt((z**2).mean()) < HONEST[1]


@pytest.mark.parametrize("board", [REGULAR, ASYMMETRIC, HEXAGONAL], ids=lambda board: board.board_id)
def test_sigmas_hold_under_jpeg(board: Board) -> None:
    """Its noise changes sign from pixel to pixel: taken for white, errors are 0.62 to 0.7 of the sigmas."""
    photometry = replace(NOISY, noise_levels=1.0, jpeg_quality=85)
    relative = []
    for seed in range(2):
        rng = np.random.default_rng(seed)
        scene = one_board(rng, board=board)
        (found,) = detect_boards(scene.render(photometry=photometry, rng=rng), [board])
        turns = [found, *(found.turned(k) for k in board.turns)]
        tried = (errors_by_place(turn, scene.truth()[0]) / turn.sigma_px[:, None] for turn in turns)
        relative.append(min(tried, key=lambda e: float(np.abs(e).max())))
    assert HONEST[0] < np.sqrt((np.concatenate(relative) ** 2).mean()) < HONEST[1]


@pytest.mark.parametrize("board", [REGULAR, ASYMMETRIC], ids=["regular", "asymmetric"])
@pytest.mark.parametrize("middle", [60.0, 200.0], ids=["not clipped", "clipped"])
def test_sigmas_hold_under_glare(board: Board, middle: float) -> None:
    relative = []
    for seed in range(3):
        rng = np.random.default_rng(seed)
        scene = one_board(rng, lens="regular", board=board)
        light = np.asarray(scene.render(blur_px=0.7), np.float64)
        (truth,) = scene.truth()
        v, u = np.mgrid[: light.shape[0], : light.shape[1]]
        at = truth.pixels.mean(axis=0) + rng.normal(0.0, 40.0, 2)
        light += middle * np.exp(-0.5 * ((u - at[0]) ** 2 + (v - at[1]) ** 2) / 48.0**2)
        image = np.clip(np.rint(light + rng.normal(0.0, 2.0, light.shape)), 0, 255).astype(np.uint8)
        (found,) = find_grids(image)
        nearest = np.linalg.norm(found.pixels[:, None] - truth.pixels, axis=2).argmin(axis=1)
        relative.append((found.pixels - truth.pixels[nearest]) / found.sigma_px[:, None])
    assert HONEST_UNDER_GLARE[0] < np.sqrt((np.concatenate(relative) ** 2).mean()) < HONEST_UNDER_GLARE[1]


def test_real_circles_that_motion_joins_are_found() -> None:
    """The first fits, without motion, leave 28 of 336 circles."""
    image = read_grey(shared_data("public/circles-hexagonal") / "image01.jpg")
    board = board_of_words("circles:14x24x12,layout=hexagonal,stagger=left,diameter_mm=10")
    moved = cv2.filter2D(image, -1, np.array([[0.5, *[1.0] * 7, 0.5]]) / 8.0)
    ((still,), (found,)) = (detect_boards(picture, [board]) for picture in (image, moved))
    assert found.complete
    in_sigmas = (found.pixels - still.pixels) / found.sigma_px[:, None]
    assert np.sqrt((in_sigmas**2).mean()) < HONEST[1]


def test_the_bound_of_a_sharper_picture_is_lower() -> None:
    board = Board("s", 4, 3, 25.0, 25.0, pattern=Circles(diameter_mm=15.0))
    scene = one_board(np.random.default_rng(0), board=board, size_px=(160, 120))
    sharp, soft = (position_bound(circle_information(scene, blur_px), 2.0) for blur_px in (0.7, 1.4))
    assert len(sharp) == 12
    assert (np.linalg.eigvalsh(soft - sharp) > 0.0).all()
    with pytest.raises(InputError, match="no circles"):
        circle_information(one_board(np.random.default_rng(0), size_px=(160, 120)), 0.7)


@pytest.mark.parametrize("board", [REGULAR, HEXAGONAL], ids=["regular", "hexagonal"])
@pytest.mark.parametrize("lens", ["regular", "fisheye"])
def test_centres_are_as_fine_as_the_pixels_allow(board: Board, lens: str) -> None:
    relative = []
    for seed in (0, 1):
        rng = np.random.default_rng(seed)
        scene = one_board(rng, lens=lens, board=board)
        truth = scene.truth()[0]
        bound = position_bound(circle_information(scene, 0.7), 2.0)
        light, photometry = scene.radiance(Optics(0.7)), replace(BENCH_PHOTOMETRY, noise_levels=2.0)
        for _ in range(3):
            (found,) = detect_boards(develop(light, photometry, rng), [board])
            turns = [found, *(found.turned(k) for k in board.turns)]
            off = min((errors_by_place(turn, truth) for turn in turns), key=lambda e: float(np.abs(e).max()))
            assert found.complete
            relative.append((off**2).sum(axis=1).mean() / np.trace(bound, axis1=1, axis2=2).mean())
    assert np.sqrt(np.mean(relative)) < MAX_BOUND
