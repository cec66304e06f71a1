"""The purpose of a rig as a weight on the errors of its lenses and mounts together."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from rigkit.calibration.rig.projection import RigProjection
from rigkit.calibration.rig.solving.layout import Layout
from rigkit.cameras.base import Camera
from rigkit.cameras.compare import grid_pixels
from rigkit.core.arrays import FloatArray, Points
from rigkit.geometry.rigid3 import Rigid3
from rigkit.geometry.rotation import skew
from rigkit.planning.goal import GOAL_GRID, Goal, rays_within


def rig_goal(
    cameras: Sequence[Camera], cam_from_rig: Sequence[Rigid3], distance_mm: float, field_deg: float | None = None
) -> Goal:
    """Return the mean square error of the projections of all cameras, for points at a distance in front of each: errors
    of lenses and mounts together move the projections of one point in two cameras. The motion of the world, which
    boards leave undetermined, is chosen for the smallest error. Points are within a field of view of `field_deg`.

    Its weight is on the parameters of all cameras, then the mounts of all but the first (`Layout.of_cameras`): left
    rotation perturbation, rad, and translation, mm.
    """
    placed, layout = list(zip(cameras, cam_from_rig, strict=True)), Layout.of_cameras(cameras)
    points = np.concatenate([_points_in_view(c, pose, distance_mm, field_deg) for c, pose in placed])
    rows = np.concatenate([_design(c, pose, points, layout, k, field_deg) for k, (c, pose) in enumerate(placed)])
    # Rotations in radians and translations in millimetres, scaled to equal effects at the distance.
    motion = rows[:, layout.count :] / np.array([1.0, 1.0, 1.0, *[1.0 / distance_mm] * 3])
    along, _ = np.linalg.qr(motion)
    left = rows[:, : layout.count] - along @ (along.T @ rows[:, : layout.count])
    what = f"rms error of all projections at {distance_mm:.0f} mm, with extrinsics"
    return Goal(left.T @ left / (len(rows) / 2), "px", what)


def _points_in_view(camera: Camera, cam_from_rig: Rigid3, distance_mm: float, field_deg: float | None) -> Points:
    """Return points at a distance all over a camera's image, in the rig's frame."""
    rays = rays_within(camera, grid_pixels(camera.size_px, GOAL_GRID).reshape(-1, 2), field_deg)
    return cam_from_rig.inverse().apply(distance_mm * rays)


def _design(
    camera: Camera, cam_from_rig: Rigid3, points: Points, layout: Layout, k: int, field_deg: float | None
) -> FloatArray:
    """Return the derivatives (2 N, G + 6) of the pixels of the points that camera `k` sees: by the parameters of the
    layout, and by a motion of the world."""
    found = RigProjection.of(camera, cam_from_rig, points, layout, k)
    seen = found.seen
    if field_deg is not None:
        in_cam = cam_from_rig.apply(points)
        seen &= in_cam[:, 2] >= np.cos(np.radians(0.5 * field_deg)) * np.linalg.norm(in_cam, axis=-1)
    # x = R (exp(W) X + T) + t.
    by_world = found.d_pixels_d_point[seen]
    motion = np.concatenate([-by_world @ skew(points[seen]), by_world], axis=-1)
    return np.concatenate([found.d_pixels_d_globals[seen], motion], axis=-1).reshape(-1, layout.count + 6)
