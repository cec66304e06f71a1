"""Partial boards of known size: placed where their borders determine the place, and never wrongly."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from detection_bench.scenes import BENCH_PHOTOMETRY, BenchScene, bench_camera, one_board

from rigkit.core.boards import Board
from rigkit.core.detections import BoardDetection
from rigkit.detection.checks.border import Side, board_sides, squares_end
from rigkit.detection.detect import detect_boards
from rigkit.detection.lattices import find_lattices
from rigkit.detection.saddles.response import grey_image
from rigkit.geometry.rigid3 import Rigid3
from rigkit.geometry.rotation import exp_so3
from rigkit.synthetic.render import Optics
from rigkit.synthetic.scene import Panel, PlacedBoard, place_board

SIZES = ((11, 8), (9, 6), (8, 6), (7, 7), (10, 7), (6, 5))
SAME_PX = 2.0


def part_scene(seed: int, lens: str, covered: bool) -> tuple[BenchScene, np.random.Generator]:
    """Return a board of any size and margin that the frame cuts, or that a sheet of any grey lies on.

    Every other sheet lies along the squares, and its edges may lie on theirs; some are as white as the paper.
    """
    rng = np.random.default_rng([seed, covered])
    board = Board("b", *SIZES[rng.integers(len(SIZES))], 30.0, 30.0)
    camera = bench_camera(lens)
    placed = None
    while placed is None:
        target = rng.uniform(0.0, 1.0, 2) * camera.size_px
        placed = place_board(board, camera, target, 34.0 * rng.uniform(0.5, 1.5), 45.0, rng)
        if placed is not None:
            seen = placed.see(camera, Rigid3.identity())[1].mean()
            placed = placed if (seen == 1.0 if covered else 0.33 < seen < 0.97) else None
    placed = replace(placed, margin_squares=float(rng.choice([0.0, 0.3, 0.5, 1.0])), first_black=bool(rng.integers(2)))
    panels: tuple[Panel, ...] = ()
    if covered:
        spot = rng.uniform(-1.0, board.size) * 30.0
        if rng.uniform() < 0.5:
            spot = np.round(spot / 15.0) * 15.0
        angle = rng.choice([0.0, 0.5 * np.pi, rng.uniform(0.0, np.pi)])
        pose = placed.world_from_board @ Rigid3(exp_so3(np.array([0.0, 0.0, angle])), np.array([*spot, -1.0]))
        width_mm, height_mm = rng.uniform(20.0, 300.0, 2)
        panels = (Panel(pose, width_mm, height_mm, float(rng.choice([0.06, 0.35, 0.6, 0.8, 0.85]))),)
    behind = placed.world_from_board @ Rigid3(np.eye(3), np.array([100.0, 100.0, 3.0]))
    wall = Panel(behind, 3000.0, 3000.0, float(rng.choice([0.05, 0.35, 0.6, 0.8])))
    field = 185.0 if lens == "fisheye" else None
    return BenchScene("part", (placed,), (wall,), camera, field, panels), rng


def rightly_placed(found: BoardDetection, truth: BoardDetection) -> bool:
    """Return whether the corners have their own place, up to the turns that no image of the board can tell."""
    for turn in range(4):
        turned = truth.turned(turn)
        if (turned.columns, turned.rows) == (found.columns, found.rows):
            off = found.pixels - turned.lattice()[found.grid[:, 1], found.grid[:, 0]]
            if (np.linalg.norm(off, axis=1) < SAME_PX).mean() > 0.9:
                return True
    return False


def count(seeds: range, lens: str, covered: bool) -> tuple[int, int, int]:
    """Return how many parts were placed rightly, wrongly, and left as parts."""
    right = wrong = left = 0
    for seed in seeds:
        scene, rng = part_scene(seed, lens, covered)
        noise, blur = float(rng.choice([0.0, 2.0, 5.0])), float(rng.choice([0.5, 0.8, 1.2]))
        photometry = replace(BENCH_PHOTOMETRY, noise_levels=noise)
        image = scene.render(optics=Optics(blur, supersample=2), photometry=photometry, rng=rng)
        board = scene.boards[0].board
        without = {d.columns * d.rows for d in detect_boards(image)}
        for found in detect_boards(image, [board]):
            if {found.columns, found.rows} != set(board.size):
                left += 1
            elif rightly_placed(found, scene.truth()[0]):
                right += board.corner_count not in without
            else:
                wrong += 1
    return right, wrong, left


def test_parts_of_boards_are_never_placed_wrongly() -> None:
    results = [count(range(20), "regular", covered) for covered in (False, True)]
    assert sum(r[0] for r in results) >= 5
    assert sum(r[1] for r in results) == 0


@pytest.mark.slow
@pytest.mark.parametrize("lens", ["regular", "fisheye"])
@pytest.mark.parametrize("covered", [False, True])
def test_hundreds_of_parts(lens: str, covered: bool) -> None:
    right, wrong, left = count(range(100, 220), lens, covered)
    assert wrong == 0
    assert right > 0.2 * (right + left)


def straight(board: Board, shift_mm: tuple[float, float], margin: float = 0.5) -> BenchScene:
    """Return a board before the regular camera, nearly parallel to it, moved sideways."""
    turn = exp_so3(np.array([0.1, 0.05, 0.02]))
    middle = turn @ np.array([15.0 * (board.columns - 1), 15.0 * (board.rows - 1), 0.0])
    pose = Rigid3(turn, np.array([*shift_mm, 450.0]) - middle)
    placed = PlacedBoard(board, pose, margin_squares=margin)
    return BenchScene("straight", (placed,), (), bench_camera("regular"))


def test_what_lies_beyond_each_side_is_read_from_the_image(rng: np.random.Generator) -> None:
    image = straight(Board("b", 9, 6, 30.0, 30.0), (-210.0, 0.0)).render(noise_levels=2.0, rng=rng)
    (item,) = find_lattices(grey_image(image), 12)
    assert item.lattice.size[0] < 9
    top, left, bottom, right = (beyond.side for beyond in board_sides(grey_image(image), item.lattice))
    assert {top, bottom} == {Side.BORDER}
    assert {left, right} == {Side.BORDER, Side.UNKNOWN}
    # Without its last two columns the board goes on beyond what is left.
    inner = item.lattice.cut(slice(0, 6), slice(0, item.lattice.size[0] - 2))
    assert board_sides(grey_image(image), inner)[3].side is Side.CONTINUES


def test_a_board_cut_on_one_side_has_its_place_and_its_name(rng: np.random.Generator) -> None:
    board = Board("b", 9, 6, 30.0, 30.0)
    scene = straight(board, (-210.0, 0.0))
    (found,) = detect_boards(scene.render(noise_levels=2.0, rng=rng), [board])
    assert (found.board_id, found.columns, found.rows) == ("b", 9, 6)
    assert not found.complete
    truth = scene.truth()[0]
    assert np.nanmax(np.abs(found.lattice() - truth.lattice())) < 0.1


def test_a_board_cut_on_two_sides_stays_a_part_where_two_places_are_left(rng: np.random.Generator) -> None:
    board = Board("b", 9, 6, 30.0, 30.0)
    image = straight(board, (-290.0, -170.0)).render(noise_levels=2.0, rng=rng)
    (found,) = detect_boards(image, [board])
    assert found.board_id is None
    assert (found.columns, found.rows) not in ((9, 6), (6, 9))
    # Of a board that is as wide as high both places are one.
    square = Board("b", 8, 8, 30.0, 30.0)
    scene = straight(square, (-290.0, -170.0))
    (found,) = detect_boards(scene.render(noise_levels=2.0, rng=rng), [square])
    assert (found.columns, found.rows) == (8, 8)
    assert rightly_placed(found, scene.truth()[0])


@pytest.mark.parametrize("blur_px", [0.7, 5.0])
def test_a_board_ends_quietly_and_a_part_of_it_does_not(blur_px: float) -> None:
    scene = one_board(np.random.default_rng(1))
    truth = scene.truth()[0]
    image = grey_image(scene.render(rng=np.random.default_rng(1), blur_px=blur_px, noise_levels=2.0))
    (found,) = find_lattices(image, 12, [(truth.columns, truth.rows)])
    assert squares_end(image, found.lattice)
    for part in ((slice(None), slice(1, None)), (slice(0, -1), slice(None))):
        assert not squares_end(image, found.lattice.cut(*part))
