"""Boards put where a camera sees them at a given place and size in its image."""

from __future__ import annotations

import numpy as np

from rigkit.cameras.base import Camera
from rigkit.core.arrays import FloatArray
from rigkit.core.boards import Board
from rigkit.geometry.rigid3 import Rigid3
from rigkit.geometry.rotation import exp_so3, unit
from rigkit.synthetic.scene import PlacedBoard


def place_board(
    board: Board,
    camera: Camera,
    target_px: FloatArray,
    square_px: float,
    max_tilt_deg: float,
    rng: np.random.Generator,
) -> PlacedBoard | None:
    """Return the board with its centre seen at `target_px`, or None where the lens does not see there."""
    ray, valid = camera.unproject(target_px)
    if not valid:
        return None
    # Pixels per radian at the target: the board's distance follows from the size of a square.
    scale = 1.0 / np.linalg.svd(camera.ray_jacobian(target_px), compute_uv=False)[0]
    depth = board.square_x_mm * scale / square_px
    facing = _rotation_to(ray)
    axis = rng.uniform(0.0, 2.0 * np.pi)
    tilt = np.radians(max_tilt_deg) * np.sqrt(rng.uniform())
    turn = exp_so3(tilt * np.array([np.cos(axis), np.sin(axis), 0.0]))
    roll = exp_so3(np.array([0.0, 0.0, rng.uniform(-np.pi, np.pi)]))
    rotation = facing @ turn @ roll
    middle = np.array([(board.columns - 1) * board.square_x_mm, (board.rows - 1) * board.square_y_mm, 0.0]) / 2.0
    return PlacedBoard(board, Rigid3(rotation, ray * depth - rotation @ middle))


def _rotation_to(ray: FloatArray) -> FloatArray:
    """Return a rotation whose z axis is `ray`."""
    helper = np.array([0.0, 1.0, 0.0]) if abs(ray[1]) < 0.9 else np.array([1.0, 0.0, 0.0])
    x = unit(np.cross(helper, ray))
    return np.stack([x, np.cross(ray, x), ray], axis=1)


def sees_paper(
    placed: PlacedBoard, camera: Camera, low: FloatArray | tuple[float, float], high: FloatArray | tuple[int, int]
) -> bool:
    """Say whether the whole paper is seen between two image corners."""
    pixels, valid = camera.project(placed.outline())
    corners, seen = placed.see(camera, Rigid3.identity())
    if not (valid.all() and seen.all()):
        return False
    both = np.concatenate([pixels, corners])
    return bool((both > np.asarray(low) + 2.0).all() and (both < np.asarray(high) - 3.0).all())
