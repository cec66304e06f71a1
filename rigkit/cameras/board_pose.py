"""The pose of a board from its corners in the image of any camera, and what errors of lens and board do to it."""

from __future__ import annotations

import numpy as np

from rigkit.cameras.base import Camera
from rigkit.cameras.moving_pupil import NearCamera
from rigkit.core.arrays import FloatArray, Pixels, Points
from rigkit.geometry.board_pose import board_pose, moved_board_poses
from rigkit.geometry.rigid3 import Rigid3
from rigkit.geometry.rotation import skew

MAX_PUPIL_ROUNDS, SETTLED_PUPIL_PX = 30, 1e-6
"""Each round multiplies the error by the pupil's movement over the board's distance."""


def cam_from_seen_board(camera: Camera, pixels: Pixels, points_mm: Points) -> Rigid3:
    """Return the pose of a board with corners `points_mm` (N, 3) at `pixels` (N, 2), from those in the field of view.

    Raises as `board_pose`: DegenerateError for fewer than four, or collinear ones.
    """
    if isinstance(camera, NearCamera):
        return _settled(camera, pixels, points_mm)[1]
    rays, valid = camera.unproject(pixels)
    return board_pose(rays[valid], points_mm[valid]).cam_from_board


def board_with_fixed_pupil(camera: NearCamera, pixels: Pixels, points_mm: Points) -> Pixels:
    """Return the pixels (N, 2) that a board's corners `points_mm` (N, 3), seen at `pixels` (N, 2), would have if the
    pupil did not move, for functions that assume a central lens. Corners outside the field of view are not changed.

    Raises as `board_pose`.
    """
    return _settled(camera, pixels, points_mm)[0]


def _settled(camera: NearCamera, pixels: Pixels, points_mm: Points) -> tuple[Pixels, Rigid3]:
    """Return the corners of `board_with_fixed_pupil`, and the pose of the board."""
    out, pose = pixels, cam_from_seen_board(camera.lens, pixels, points_mm)
    for _ in range(MAX_PUPIL_ROUNDS):
        moved = camera.as_with_fixed_pupil(pixels, pose.apply(points_mm))
        moved = np.where(np.isfinite(moved), moved, pixels)
        change = float(np.abs(moved - out).max())
        out = moved
        # Refined from the last pose: estimating it from scratch in each round takes 1.8 times as long.
        rays, valid = camera.lens.unproject(out)
        pose = moved_board_poses(rays[valid][None], points_mm[valid], pose)[0].cam_from_board
        if change <= SETTLED_PUPIL_PX:
            break
    return out, pose


def pose_covariance_of_lens(
    camera: Camera,
    covariance: FloatArray,
    points_in_cam: Points,
    origin_in_cam: FloatArray,
    sigma_px: FloatArray,
    by_board: FloatArray | None = None,
) -> FloatArray:
    """Return the part of a board pose's covariance that comes from the lens and the board: (6, 6) of (w, v),
    R' = exp([w]x) R, t' = t + v, rad and mm.

    The corners fix the pixels: from dq = A dp + K dk = 0 follows dp = -(A^T W A)^-1 A^T W K dk.

    Parameters
    ----------
    covariance : (P + B, P + B) of the camera's parameters and of B unknowns of the board's shape.
    points_in_cam, origin_in_cam : (N, 3) and (3,) the board's points and its origin, mm.
    sigma_px : (N,) standard deviations of the corners.
    by_board : (N, 3, B) derivatives of the points by those unknowns; None for a board that is exactly known.
    """
    _, _, d_pixels_d_point, by_known = camera.project_with_jacobians(points_in_cam)
    if by_board is not None:
        by_known = np.concatenate([by_known, d_pixels_d_point @ by_board], axis=-1)
    by_pose = np.concatenate([-d_pixels_d_point @ skew(points_in_cam - origin_in_cam), d_pixels_d_point], axis=-1)
    weight, count = 1.0 / sigma_px[:, None, None], 2 * len(points_in_cam)
    step = np.linalg.lstsq((by_pose * weight).reshape(count, -1), (by_known * weight).reshape(count, -1), rcond=None)[0]
    return np.asarray(step @ covariance @ step.T)
