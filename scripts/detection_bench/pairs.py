"""Pairs of views of identical boards, and whether identification matched the same corners.

Three boards of one size, each of which looks the same rotated by 180 degrees, are the hardest case: only the geometry
of both views determines their identities and orientations.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from enum import StrEnum

import numpy as np
from scipy.spatial import cKDTree

from detection_bench.scenes import LENSES, bench_camera
from rigkit.cameras.base import Camera
from rigkit.core.arrays import FloatArray
from rigkit.core.boards import Board
from rigkit.core.detections import BoardDetection
from rigkit.core.errors import DegenerateError
from rigkit.core.posetype import PoseType
from rigkit.geometry.rigid3 import Rigid3
from rigkit.geometry.rotation import exp_so3
from rigkit.synthetic.pairs import StereoScene, random_pair, trihedral_pair
from rigkit.synthetic.scene import PlacedBoard, room_walls, wall_axes

EQUAL_BOARDS = tuple(Board(name, 8, 6, 40.0, 40.0) for name in ("plane1", "plane2", "plane3"))
"""Columns + rows is even: each looks the same turned by 180 degrees."""
SAME_PX = 1.0
"""A corner is the true corner within this distance; neighbours are at least ten times as far."""
BENCH_POSE_TYPES = (PoseType.GENERAL, PoseType.PLANAR, PoseType.STANDARD, PoseType.FORWARD)
PAIR_TRIES = 50
RIGHT_ANGLES = (90.0, 90.0, 90.0)
CLEAR_MM, AWAY_MM = 8.0, 160.0
"""Boards that do not stand in the corner of the room are away from it by this much along both walls."""
OFF_SYMMETRY_MM = (0.0, 0.5, 1.0, 3.0, 6.0)
PARALLAX_DEG = (8.0, 45.0)


class PairVerdict(StrEnum):
    """How a pair was identified.

    RIGHT: all boards, every corner with its own index. AMBIGUOUS: the tie was stated. INCOMPLETE: what was answered is
    right, but boards are missing. WRONG: a corner was given another one's index, and no tie was stated.
    """

    RIGHT = "right"
    AMBIGUOUS = "ambiguous"
    INCOMPLETE = "incomplete"
    WRONG = "wrong"


def equal_boards_pair(seed: int, *, size_px: tuple[int, int] = (800, 600)) -> tuple[str, StereoScene]:
    """Return what a pair is, in words that begin with its lens, and the pair.

    By turns: regular and fisheye; boards in the corner of the room as in a laboratory (all pose types), and anywhere on
    the walls, turned by any angle (free views). Every tenth pair is a trap: a third of a turn maps the three boards
    onto each other, exactly or but for a few millimetres, so that an honest answer may be that it cannot be told.
    """
    rng = np.random.default_rng(seed)
    lens = LENSES[(seed + seed // 10) % len(LENSES)]
    camera = bench_camera(lens, size_px)
    if seed % 10 == 9:
        off_mm = OFF_SYMMETRY_MM[seed // 20 % len(OFF_SYMMETRY_MM)]
        pair = _random_pair(lambda: _cyclic_boards(off_mm, rng), camera, rng)
        return f"{lens}, {off_mm:g} mm from symmetric", pair
    if seed // 2 % 2 == 0:
        pose_type = BENCH_POSE_TYPES[seed // 4 % 4]
        pair = trihedral_pair(EQUAL_BOARDS, camera, pose_type, rng, baseline_mm=200.0)
        return f"{lens}, in the corner, {pose_type}", pair
    walls = wall_axes(RIGHT_ANGLES)

    def boards() -> list[PlacedBoard]:
        return [_on_wall(board, axes, rng) for board, axes in zip(EQUAL_BOARDS, walls, strict=True)]

    return f"{lens}, anywhere on the walls", _random_pair(boards, camera, rng)


def _random_pair(boards: Callable[[], Sequence[PlacedBoard]], camera: Camera, rng: np.random.Generator) -> StereoScene:
    for _ in range(PAIR_TRIES):
        try:
            return random_pair(
                boards(),
                camera,
                PoseType.GENERAL,
                rng,
                panels=lambda reach_mm: room_walls(12.0 * reach_mm),
                parallax_deg=PARALLAX_DEG,
            )
        except DegenerateError:
            continue
    raise DegenerateError(f"equal boards: no two views of {PAIR_TRIES} arrangements saw all boards")


def _cyclic_boards(off_mm: float, rng: np.random.Generator) -> list[PlacedBoard]:
    """Return three boards that a third of a turn about the corner's diagonal maps onto each other, but for `off_mm`."""
    third = Rigid3(np.roll(np.eye(3), 1, axis=0), np.zeros(3))
    pose = _on_wall(EQUAL_BOARDS[0], wall_axes(RIGHT_ANGLES)[0], rng).world_from_board
    placed = []
    for board in EQUAL_BOARDS:
        in_plane = np.array([*rng.uniform(-1.0, 1.0, 2) * off_mm, 0.0])
        placed.append(PlacedBoard(board, pose @ Rigid3(np.eye(3), in_plane)))
        pose = third @ pose
    return placed


def _on_wall(board: Board, axes: FloatArray, rng: np.random.Generator) -> PlacedBoard:
    """Return the board on a wall, turned at random, all of its paper on the room's side of the other walls."""
    turn = exp_so3(np.array([0.0, 0.0, rng.uniform(-np.pi, np.pi)]))
    turned = PlacedBoard(board, Rigid3(axes @ turn, np.zeros(3)))
    # The room is x, y, z < 0: the paper's highest coordinates along the wall go to a random place below zero.
    along = np.abs(axes[:, 2]) < 0.5
    shift = np.where(along, -turned.outline().max(axis=0) - rng.uniform(CLEAR_MM, AWAY_MM, 3), 0.0)
    return PlacedBoard(board, Rigid3(axes @ turn, shift))


def evaluate_pair(
    scene: StereoScene, pairs: Sequence[tuple[BoardDetection, BoardDetection]], ambiguous: bool
) -> PairVerdict:
    """Say whether equal indices of `pairs` (boards of image 1 and 2) are the same physical corners."""
    if ambiguous:
        return PairVerdict.AMBIGUOUS
    truth = [_lookup(found) for found in scene.detections()]
    for one, two in pairs:
        physical = [
            {tuple(g): name for g, name in zip(d.grid.tolist(), _physical(d, *known), strict=True) if name is not None}
            for d, known in zip((one, two), truth, strict=True)
        ]
        shared = set(physical[0]) & set(physical[1])
        if not shared or any(physical[0][g] != physical[1][g] for g in shared):
            return PairVerdict.WRONG
    return PairVerdict.RIGHT if len(pairs) == len(scene.boards) else PairVerdict.INCOMPLETE


def _lookup(truth: Sequence[BoardDetection]) -> tuple[cKDTree, list[tuple[str | None, int, int]]]:
    names = [(t.board_id, int(column), int(row)) for t in truth for column, row in t.grid]
    return cKDTree(np.concatenate([t.pixels for t in truth])), names


def _physical(
    found: BoardDetection, tree: cKDTree, names: Sequence[tuple[str | None, int, int]]
) -> list[tuple[str | None, int, int] | None]:
    """Return which true corner each corner is, None where it is none."""
    distance, index = tree.query(found.pixels)
    return [names[i] if d < SAME_PX else None for d, i in zip(distance, index, strict=True)]
