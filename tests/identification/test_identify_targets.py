"""Targets whose points are not one square apart, in a pair: identified, placed, with exact directions."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from helpers.board_scenes import fisheye_camera, regular_camera

from rigkit.core.boards import Board
from rigkit.core.errors import InputError
from rigkit.core.patterns.aprilgrid import AprilGrid
from rigkit.core.patterns.base import Pattern
from rigkit.core.patterns.circles import Circles
from rigkit.core.posetype import PoseType
from rigkit.reconstruction.pairing import match_pair
from rigkit.synthetic.pairs import StereoScene, trihedral_pair

STEP = 1e-4
"""Of finite differences, in squares."""


def boards(kind: str) -> tuple[Board, ...]:
    patterns: list[Pattern]
    if kind == "aprilgrid":
        sizes, side = [(8, 6), (6, 6), (6, 8)], 60.0
        patterns = [AprilGrid(spacing=0.3, first_tag=20 * k) for k in range(3)]
    else:
        sizes, side = [(4, 9), (5, 8), (3, 9)], 90.0
        patterns = [Circles(layout=kind), Circles(layout=kind, stagger="left"), Circles(layout=kind)]
    return tuple(
        Board(f"plane{k}", *size, side, side, pattern=pattern)
        for k, (size, pattern) in enumerate(zip(sizes, patterns, strict=True), start=1)
    )


def scene_of(kind: str, *, fisheye: bool) -> StereoScene:
    camera = fisheye_camera() if fisheye else regular_camera()
    rng = np.random.default_rng(7)
    return trihedral_pair(boards(kind), camera, PoseType.GENERAL, rng, parallax_deg=(15.0, 40.0))


@pytest.mark.parametrize("fisheye", [False, True])
@pytest.mark.parametrize("kind", ["aprilgrid", "asymmetric", "hexagonal"])
def test_the_pair_is_exact_and_so_are_its_directions(kind: str, fisheye: bool) -> None:
    scene = scene_of(kind, fisheye=fisheye)
    found = [list(detections) for detections in scene.detections()]
    if kind != "aprilgrid":
        # Nothing on circles names them; a board that looks the same turned may be counted from its other end.
        found = [[replace(d, board_id=None) for d in own] for own in found]
        found[1] = [d.turned(2) if d.rows % 2 == 0 else d for d in found[1]]
    listed = boards(kind)
    pair = match_pair("pair", scene.camera1, scene.camera2, found[0], found[1], listed)
    assert [board.board_id for board in pair.boards] == [board.board_id for board in listed]
    assert not pair.identity.ambiguous
    assert pair.identity.residual_px < 1e-6
    # Without sizes told the frame of the pair is the boards' own: the true one.
    moved = pair.identity.cam2_from_cam1.inverse() @ scene.cam2_from_cam1
    assert np.linalg.norm(moved.translation_mm) < 1e-6 * scene.baseline_mm
    worst = 0.0
    for index, board in enumerate(pair.boards):
        on = pair.matches.board_index == index
        pose = pair.identity.cam1_from_board[board.board_id]
        points = board.points(pair.matches.grid[on])
        steps = STEP * np.array([[board.square_x_mm, 0.0, 0.0], [0.0, board.square_y_mm, 0.0]])
        for k in range(2):
            ahead, back = (scene.camera1.project(pose.apply(points + way * steps[k]))[0] for way in (1.0, -1.0))
            true = (ahead - back) / (2.0 * STEP)
            off = np.linalg.norm(pair.directions.image1[on, k] - true, axis=1) / np.linalg.norm(true, axis=1)
            worst = max(worst, float(off.max()))
    assert pair.directions.valid.all()
    assert worst < 1e-5


def test_an_uneven_board_has_no_directions_from_neighbours() -> None:
    scene = scene_of("asymmetric", fisheye=False)
    with pytest.raises(InputError, match="use 'patch'"):
        first, second = scene.detections()
        match_pair("pair", scene.camera1, scene.camera2, first, second, boards("asymmetric"), support="line")
