"""The pose of a flat board from its corners in the image of any camera."""

from __future__ import annotations

from rigkit.cameras.base import Camera
from rigkit.core.arrays import Pixels, Points
from rigkit.geometry.board_pose import board_pose
from rigkit.geometry.rigid3 import Rigid3


def cam_from_seen_board(camera: Camera, pixels: Pixels, points_mm: Points) -> Rigid3:
    """Return the pose of a board with corners `points_mm` (N, 3) at `pixels` (N, 2), by those that the lens can see.

    Raises as `board_pose`: DegenerateError for fewer than four, or collinear ones.
    """
    rays, valid = camera.unproject(pixels)
    return board_pose(rays[valid], points_mm[valid]).cam_from_board
