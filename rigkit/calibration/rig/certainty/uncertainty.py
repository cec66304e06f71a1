"""Uncertainty of a rig in pixels: of the projection into one camera of a point that another one sees.

A point x at a known distance on the ray of a pixel of camera 1 changes with the intrinsics k1, as the pixel is fixed,
and with the mounts; in camera 2

    dq2 = dq2/dk2 dk2 + dq2/dx2 (dM2 + R21 (dx1 - dM1)),      dx1 = -(dq1/dx1)+ dq1/dk1 dk1,

where dM = w x (x - t) + dt is the motion of a point in the camera by a perturbation of its mount, and + is the inverse
perpendicular to the ray. `RigProjection` has the derivatives.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rigkit.calibration.certainty.uncertainty import worst_direction
from rigkit.calibration.rig.result import RigCalibration
from rigkit.calibration.rig.solving.layout import Layout
from rigkit.cameras.base import Camera
from rigkit.core.arrays import BoolArray, FloatArray, Points, spread_indices
from rigkit.geometry.rigid3 import Rigid3
from rigkit.geometry.rotation import skew

TRANSFER_POINTS = 40
"""Number of corners, spread over all views, at which the transfer is evaluated."""


@dataclass(frozen=True, slots=True)
class Transfer:
    """Uncertainty of the transfer from camera `a` to camera `b`: standard deviation in the worst direction, px, median
    and maximum over corners that `a` saw and that are in the image of `b`."""

    a: str
    b: str
    median_px: float
    worst_px: float


def transfer_uncertainty(rig: RigCalibration, a: str, b: str) -> Transfer | None:
    """Return the uncertainty of the transfer of the boards' corners from camera `a` to camera `b`; None where none of
    them is in the image of `b`."""
    calibration = rig.cameras[rig.index(a)].calibration
    shown = {shape.board_id: shape.points_mm[:: max(1, len(shape.points_mm) // 8)] for shape in calibration.boards}
    boards = [shown[view.board_id] for view in calibration.views]
    end = np.cumsum([len(points) for points in boards])
    chosen = spread_indices(end[-1], TRANSFER_POINTS)
    view = np.searchsorted(end, chosen, side="right")
    on_board = np.array([boards[v][k] for v, k in zip(view, chosen - end[view], strict=True)])
    corners = calibration.corners
    points = np.einsum("nij,nj->ni", corners.rotation[view], on_board) + corners.translation_mm[view]
    covariance, seen = transfer_covariance(rig, a, b, points)
    if not seen.any():
        return None
    worst = worst_direction(covariance[seen])
    return Transfer(a, b, float(np.median(worst)), float(worst.max()))


def transfer_covariance(rig: RigCalibration, a: str, b: str, points: Points) -> tuple[FloatArray, BoolArray]:
    """Return the covariance (N, 2, 2), px^2, of the pixels in camera `b` of `points` (N, 3) mm in camera `a`, given
    their pixels in `a` and their distances, and which points (N,) project into `a` and are in the image of `b`."""
    i, j = rig.index(a), rig.index(b)
    cameras, known = rig.quoted.cameras, rig.quoted.covariance
    layout, rays = Layout.of_cameras(cameras), points / np.linalg.norm(points, axis=-1, keepdims=True)
    mounts = [rig.cameras[k].cam_from_rig for k in (i, j)]
    in_rig = mounts[0].inverse().apply(points)
    first, second = (
        RigProjection.of(cameras[k], mount, in_rig, layout, k) for k, mount in zip((i, j), mounts, strict=True)
    )
    # The third row keeps the given distance.
    system = np.concatenate([first.d_pixels_d_point, rays[:, None] @ mounts[0].rotation], axis=1)
    held = np.concatenate([-first.d_pixels_d_globals, np.zeros((len(points), 1, layout.count))], axis=1)
    if (mount := layout.mounts[i]) is not None:
        lever = points - mounts[0].translation_mm
        held[:, 2, mount] = -np.concatenate([np.cross(lever, rays), rays], axis=-1)
    design = second.d_pixels_d_globals + second.d_pixels_d_point @ np.linalg.solve(system, held)
    return design @ known @ np.swapaxes(design, -1, -2), first.valid & second.seen


@dataclass(frozen=True, eq=False, slots=True)
class RigProjection:
    """Pixels of points in a camera of a rig: which are `valid` (...,), and which of these are `seen` in its image; and
    the derivatives by the points in the rig's frame (..., 2, 3) and by the G globals of a layout (..., 2, G)."""

    valid: BoolArray
    seen: BoolArray
    d_pixels_d_point: FloatArray
    d_pixels_d_globals: FloatArray

    @classmethod
    def of(cls, camera: Camera, cam_from_rig: Rigid3, points: Points, layout: Layout, k: int) -> RigProjection:
        """Return that of `points` (..., 3) mm in the rig's frame into its camera `k`."""
        in_cam = cam_from_rig.apply(points)
        pixels, valid, d_pixels_d_x, d_pixels_d_parameters = camera.project_with_jacobians(in_cam)
        d_pixels_d_globals = np.zeros((*points.shape[:-1], 2, layout.count))
        d_pixels_d_globals[..., layout.cameras[k]] = d_pixels_d_parameters
        if (mount := layout.mounts[k]) is not None:
            # x = exp(w) R X + t + v.
            by_turn = d_pixels_d_x @ -skew(in_cam - cam_from_rig.translation_mm)
            d_pixels_d_globals[..., mount] = np.concatenate([by_turn, d_pixels_d_x], axis=-1)
        d_pixels_d_point = d_pixels_d_x @ cam_from_rig.rotation
        return cls(valid, valid & camera.on_image(pixels), d_pixels_d_point, d_pixels_d_globals)
