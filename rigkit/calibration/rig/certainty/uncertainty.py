"""How far a rig may be off in pixels: where a point that one camera sees must appear in another.

A point x at a known distance on the ray of a pixel of camera 1 moves with the intrinsics k1, as the pixel stays, and
with the mounts; in camera 2

    dq2 = dq2/dk2 dk2 + dq2/dx2 (dM2 + R21 (dx1 - dM1)),      dx1 = -(dq1/dx1)+ dq1/dk1 dk1,

where dM = w x (x - t) + dt is how a mount's perturbation moves a point of its camera, seen from the rig, and + inverts
across the ray only.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rigkit.calibration.certainty.uncertainty import worst_direction
from rigkit.calibration.rig.result import RigCalibration
from rigkit.calibration.rig.solving.layout import Layout
from rigkit.core.arrays import BoolArray, FloatArray, Points
from rigkit.geometry.rotation import skew

TRANSFER_POINTS = 40
"""So many corners, spread over all views, are enough to see how sure the transfer is where the boards were."""


@dataclass(frozen=True, slots=True)
class Transfer:
    """From camera `a` to camera `b`: standard deviation in the worst direction, px, at the middle one and at the worst
    of the corners that `a` saw and `b` has in its image."""

    a: str
    b: str
    median_px: float
    worst_px: float


def transfer_uncertainty(rig: RigCalibration, a: str, b: str) -> Transfer | None:
    """Return how sure it is where the boards' corners in camera `a` must appear in camera `b`; None where `b` has none
    of their places in its image."""
    calibration = rig.cameras[rig.index(a)].calibration
    shown = {shape.board_id: shape.points_mm[:: max(1, len(shape.points_mm) // 8)] for shape in calibration.boards}
    boards = [shown[view.board_id] for view in calibration.views]
    end = np.cumsum([len(points) for points in boards])
    chosen = np.linspace(0, end[-1] - 1, min(TRANSFER_POINTS, end[-1])).astype(np.int64)
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
    """Return the covariance (N, 2, 2), px^2, of where `points` (N, 3) mm in camera `a` appear in camera `b`, their
    pixels in `a` and their distances given, and whether they do (N,)."""
    i, j = rig.index(a), rig.index(b)
    cameras, known = rig.quoted
    first, second = cameras[i], cameras[j]
    motion = rig.cam2_from_cam1(a, b)
    there = motion.apply(points)
    _, seen1, d_pixels1_d_point, d_pixels1_d_parameters = first.project_with_jacobians(points)
    pixels, seen2, d_pixels2_d_point, d_pixels2_d_parameters = second.project_with_jacobians(there)
    rays = points / np.linalg.norm(points, axis=-1, keepdims=True)
    # Across the ray: the distance is given, so the third row keeps it.
    system = np.concatenate([d_pixels1_d_point, rays[:, None, :]], axis=1)
    held = np.concatenate(
        [-d_pixels1_d_parameters, np.zeros((len(points), 1, d_pixels1_d_parameters.shape[-1]))], axis=1
    )
    by_own = np.linalg.solve(system, held)
    layout = Layout.of_cameras(cameras)
    design = np.zeros((len(points), 2, len(known)))
    turned = d_pixels2_d_point @ motion.rotation
    design[:, :, layout.cameras[i]] += turned @ by_own
    design[:, :, layout.cameras[j]] += d_pixels2_d_parameters
    for k, x, by_x, sign in ((i, points, turned, -1.0), (j, there, d_pixels2_d_point, 1.0)):
        if k > 0:
            lever = skew(x - rig.cameras[k].cam_from_rig.translation_mm)
            run = design[:, :, layout.mount(k)]
            run[..., :3] += sign * by_x @ -lever
            run[..., 3:] += sign * by_x
    covariance = design @ known @ np.swapaxes(design, -1, -2)
    return covariance, seen1 & seen2 & second.on_image(pixels)
