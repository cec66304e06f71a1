"""Three boards arranged like the walls and the floor of a room's corner, seen by one camera or a rig."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from rigkit.cameras.base import Camera
from rigkit.core.boards import Board
from rigkit.core.detections import BoardView
from rigkit.geometry.rigid3 import Rigid3
from rigkit.geometry.rotation import exp_so3

ALIKE = tuple(Board(f"plane{k}", 8, 6, 30.0, 30.0) for k in (1, 2, 3))
DIFFERENT = (Board("floor", 9, 6, 30.0, 30.0), Board("left", 8, 5, 30.0, 30.0), Board("right", 7, 6, 30.0, 30.0))


def corner_of_a_room(rng: np.random.Generator, boards: Sequence[Board]) -> dict[str, Rigid3]:
    """Return room_from_board of boards shifted from a wall's edges, on walls that are not quite perpendicular."""
    axes = np.eye(3)
    out = {}
    for k, board in enumerate(boards):
        x, y = axes[k], axes[(k + 1) % 3]
        # From inside the corner, the board's z axis points into its wall.
        rotation = exp_so3(np.radians(1.0) * rng.normal(size=3)) @ np.stack([y, x, np.cross(y, x)], axis=-1)
        out[board.board_id] = Rigid3(rotation, (40.0 + 15.0 * k) * x + (55.0 - 10.0 * k) * y)
    return out


def looking_in(rng: np.random.Generator, distance_mm: float, spread: float = 0.25) -> Rigid3:
    """Return rig_from_room of a rig that looks into the corner from a point near its diagonal."""
    look = -np.ones(3) / np.sqrt(3.0)
    right = np.cross(look, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    turn = exp_so3(rng.normal(size=3) * np.array([0.06, 0.06, 0.5])) @ np.stack([right, np.cross(look, right), look])
    turn = turn @ exp_so3(spread * rng.normal(size=3))
    middle = np.full(3, 90.0)
    place = distance_mm * np.array([0.08 * rng.normal(), 0.08 * rng.normal(), rng.uniform(0.8, 1.3)])
    return Rigid3(turn, place - turn @ middle)


def target_views(
    rng: np.random.Generator,
    cameras: Mapping[str, tuple[Camera, Rigid3]],
    boards: Sequence[Board],
    room_from_board: Mapping[str, Rigid3],
    frames: int,
    *,
    noise_px: float,
    distance_mm: float,
    fewest: int = 3,
    shuffled: bool = False,
) -> dict[str, list[tuple[str, BoardView]]]:
    """Return frames in which every camera sees at least `fewest` boards; `shuffled`: boards of equal size are named,
    and numbered from either end, at random in every image."""
    out: dict[str, list[tuple[str, BoardView]]] = {name: [] for name in cameras}
    done = 0
    for _ in range(5000):
        if done == frames:
            break
        rig_from_room = looking_in(rng, distance_mm)
        found = {}
        for name, (camera, cam_from_rig) in cameras.items():
            own = []
            for board in boards:
                cam_from_board = cam_from_rig @ rig_from_room @ room_from_board[board.board_id]
                pixels, valid = camera.project(cam_from_board.apply(board.points()))
                facing = cam_from_board.rotation[:, 2] @ cam_from_board.apply(board.points().mean(axis=0))
                inside = valid.all() and (pixels > 1.0).all() and (pixels < np.array(camera.size_px) - 2.0).all()
                if inside and facing > 60.0:
                    own.append((board, pixels + noise_px * rng.normal(size=pixels.shape)))
            found[name] = own
        if min(len(own) for own in found.values()) < fewest:
            continue
        for name, own in found.items():
            named = [board for board, _ in own]
            if shuffled:
                order = rng.permutation(len(named))
                named = [named[k] for k in order]
            for board, (true, pixels) in zip(named, own, strict=True):
                grid = board.grid()
                if shuffled and rng.random() < 0.5:
                    grid = np.array(board.size) - 1 - grid
                assert board.size == true.size or not shuffled
                sigma = np.full(len(grid), max(noise_px, 1e-3))
                out[name].append((f"{done:03d}", BoardView(f"{name}{done:03d}", board, grid, pixels, sigma)))
        done += 1
    assert done == frames, "the boards do not fit into the view"
    return out
