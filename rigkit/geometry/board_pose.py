"""Pose of a flat or slightly bowed target from unit rays of any central camera, with any field of view.

The homography from target to rays is found linearly (rows `T_k H x_k = 0`, T_k a tangent basis at ray k), the pose from
its columns. A distant planar target has a second local optimum with the opposite tilt (planar ambiguity); both are
refined and the better one is returned. Points may have z < 0: "in front" means along the ray.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rigkit.core.arrays import FloatArray, Points, Rays, as_array
from rigkit.core.errors import DegenerateError, InputError
from rigkit.geometry.rigid3 import Rigid3
from rigkit.geometry.rotation import exp_so3, nearest_rotation, skew
from rigkit.kernels import board_pose as kernel

MIN_EXTENT_RATIO = 1e-6
"""Second principal extent over the first, below which points are collinear."""
MIN_HOMOGRAPHY_GAP = 1e-9
"""Second smallest singular value over the largest, below which the homography is not unique."""
MAX_TARGET_BOW = 0.05
"""Third principal extent over the first, above which a target is not flat enough for a homography to start from. The
bow of a paper board on cardboard is below 0.01; it is in the refinement."""
POSE_STEP_TOLERANCE = 1e-12
"""The refinement stops when a step changes the pose by less than this, in radians and relative to the distance."""
MAX_POSE_STEPS = 50


@dataclass(frozen=True, eq=False, slots=True)
class BoardPose:
    """Pose of a planar target.

    Attributes
    ----------
    cam_from_board : the pose, mm.
    rms_rad : root mean square angle between measured and predicted rays (2-D per point), radians.
    covariance : (6, 6) of (w, v): R' = exp([w]x) R, t' = t + v, in rad and mm, in the camera frame. From `sigma_rad`
        if given, otherwise scaled by the residuals; NaN without degrees of freedom.
    """

    cam_from_board: Rigid3
    rms_rad: float
    covariance: FloatArray


def facing_normal(cam_from_board: Rigid3) -> FloatArray:
    """Return the unit normal (3,) of a board, towards the camera."""
    normal = cam_from_board.rotation[:, 2]
    return np.asarray(-np.sign(normal @ cam_from_board.translation_mm) * normal)


def board_pose(rays: Rays, points_mm: Points, sigma_rad: FloatArray | None = None) -> BoardPose:
    """Return the pose of a planar target from rays (N, 3) to its points (N, 3), mm; `sigma_rad` (N,) weights them.

    Raises InputError: wrong shapes, values that are not finite, far from coplanar points; DegenerateError: fewer
    than four points, or points or rays of which all but one are collinear.
    """
    return board_poses(rays, points_mm, sigma_rad)[0]


def board_poses(
    rays: Rays, points_mm: Points, sigma_rad: FloatArray | None = None, *, bases: FloatArray | None = None
) -> tuple[BoardPose, ...]:
    """Return the local optima of `board_pose`, best first: one, or two with opposite tilts.

    `bases` (N, 2, 3), rows perpendicular to the rays, determine the unit of the residuals: radians for orthonormal rows
    (default), pixels for the pseudo-inverses of d ray / d pixel; sigma and rms are then in pixels, too.
    """
    f = as_array(rays, (None, 3), "rays")
    n = len(f)
    f = f / np.linalg.norm(f, axis=1, keepdims=True)
    points = as_array(points_mm, (n, 3), "points_mm")
    if n < 4:
        raise DegenerateError(f"board pose: {n} corners do not fix a pose; at least 4 are needed")
    sigma = np.ones(n) if sigma_rad is None else as_array(sigma_rad, (n,), "sigma_rad")
    if not (sigma > 0.0).all():
        raise InputError("board pose: sigma_rad must be positive")
    weight = 1.0 / sigma
    plane_from_target, flat = _flatten(points)
    bases = tangent_bases(f) if bases is None else as_array(bases, (n, 2, 3), "bases")
    start = _both_tilts(*_pose_from_homography(_homography(f, flat, weight)))
    seen = _SeenPlane(f, bases, flat, weight, plane_from_target)
    rotation, translation, cost = seen.refined(*start)
    order = [int(np.argmin(cost)), 1 - int(np.argmin(cost))]
    keep = order if _differ(rotation, translation, flat, cost) else order[:1]
    return seen.poses(rotation[keep], translation[keep], cost[keep], None if sigma_rad is None else 1.0)


def moved_board_poses(rays: Rays, points_mm: Points, start: Rigid3) -> tuple[BoardPose, ...]:
    """Return the poses of a planar target for M sets of rays (M, N, 3), refined from the common initial pose `start`.

    Much faster than `board_pose` for each, and always the same one of two optima.
    """
    f = rays / np.linalg.norm(rays, axis=-1, keepdims=True)
    plane_from_target, flat = _flatten(as_array(points_mm, (f.shape[1], 3), "points_mm"))
    cam_from_plane = start @ plane_from_target.inverse()
    seen = _SeenPlane(f, tangent_bases(f), flat, np.ones(len(flat)), plane_from_target)
    rotation = np.broadcast_to(cam_from_plane.rotation, (len(f), 3, 3))
    translation = np.broadcast_to(cam_from_plane.translation_mm, (len(f), 3))
    return seen.poses(*seen.refined(rotation, translation), None)


@dataclass(frozen=True, eq=False, slots=True)
class _SeenPlane:
    """N points of a target on rays of one view (N, 3), or of several (M, N, 3).

    Attributes
    ----------
    rays, bases : unit rays, and rows (..., 2, 3) perpendicular to them.
    flat, weight : (N, 3) the points in a frame centred on them with z = 0, and (N,) their weights.
    plane_from_target : that frame.
    """

    rays: Rays
    bases: FloatArray
    flat: FloatArray
    weight: FloatArray
    plane_from_target: Rigid3

    def refined(self, rotation: FloatArray, translation: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return the refined poses and costs (K,) of K initial poses of the plane: Levenberg-Marquardt on weighted ray
        residuals, in units of the bases."""
        n = len(self.flat)
        return kernel.refine(
            self.rays.reshape(-1, n, 3),
            (self.bases * self.weight[:, None, None]).reshape(-1, n, 2, 3),
            self.flat,
            rotation,
            translation,
            max_steps=MAX_POSE_STEPS,
            tolerance=POSE_STEP_TOLERANCE,
        )

    def poses(
        self, rotation: FloatArray, translation: FloatArray, cost: FloatArray, variance: float | None
    ) -> tuple[BoardPose, ...]:
        """Return the poses of the target, with rms and covariance, from those of its plane (M, ...)."""
        residual, jacobian = ray_residuals(self.rays, self.bases, self.flat, rotation, translation)
        rms = np.sqrt((residual**2).sum(axis=-1).mean(axis=-1))
        jacobian = jacobian * self.weight[:, None, None]
        poses = []
        for k, cam_from_plane in enumerate(Rigid3.stack(rotation, translation)):
            covariance = _covariance(jacobian[k], cost[k], variance)
            # t = t_plane + R_plane m, so a rotation changes t, too: v = v_plane - [R_plane m]x w.
            shift = np.eye(6)
            shift[3:, :3] = -skew(rotation[k] @ self.plane_from_target.translation_mm)
            cam_from_target = cam_from_plane @ self.plane_from_target
            poses.append(BoardPose(cam_from_target, float(rms[k]), shift @ covariance @ shift.T))
        return tuple(poses)


def tangent_bases(rays: Rays) -> FloatArray:
    """Return (..., 2, 3): two orthonormal rows perpendicular to each unit ray, smooth except at -z."""
    x, y, z = np.moveaxis(np.asarray(rays, dtype=np.float64), -1, 0)
    sign = np.where(z < 0.0, -1.0, 1.0)
    a = -1.0 / (sign + z)
    b = x * y * a
    first = np.stack([1.0 + sign * x * x * a, sign * b, -sign * x], axis=-1)
    second = np.stack([b, sign + y * y * a, -y], axis=-1)
    return np.stack([first, second], axis=-2)


def ray_residuals(
    rays: Rays, bases: FloatArray, points: Points, rotation: FloatArray, translation: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return residuals (..., N, 2) of a rigid target against rays, and their derivatives (..., N, 2, 6) by (w, v).

    `rotation` (..., 3, 3) and `translation` (..., 3) are perturbed as R' = exp([w]x) R, t' = t + v. Rays are (N, 3),
    common to all poses, or (..., N, 3). Else as `point_residuals`.
    """
    n, poses = len(points), rotation.shape[:-2]
    residual, jacobian = kernel.ray_residuals(
        rays.reshape(-1, n, 3),
        bases.reshape(-1, n, 2, 3),
        points,
        rotation.reshape(-1, 3, 3),
        translation.reshape(-1, 3),
    )
    return residual.reshape(*poses, n, 2), jacobian.reshape(*poses, n, 2, 6)


def point_residuals(rays: Rays, bases: FloatArray, points: Points) -> tuple[FloatArray, FloatArray]:
    """Return residuals (N, 2) of points (N, 3) in the camera frame against rays (N, 3), and d residual / d point
    (N, 2, 3).

    `bases` (N, 2, 3) are rows perpendicular to the rays: orthonormal for radians, the pseudo-inverse of d ray / d pixel
    for pixels. The formula is in board_pose.c.
    """
    residual, jacobian = kernel.ray_residuals(rays[None], bases[None], points, np.eye(3)[None], np.zeros((1, 3)))
    return residual[0], jacobian[0, :, :, 3:]


def _flatten(points: Points) -> tuple[Rigid3, FloatArray]:
    """Return plane_from_target and the points (N, 3) in a frame centred on them with z = 0."""
    centre = points.mean(axis=0)
    _, extent, axes = np.linalg.svd(points - centre, full_matrices=False)
    if extent[1] < MIN_EXTENT_RATIO * extent[0] or extent[0] == 0.0:
        raise DegenerateError("board pose: the corners lie on one line; corners of at least two rows are needed")
    if extent[2] > MAX_TARGET_BOW * extent[0]:
        raise InputError("board pose: the points do not lie in a plane; a flat target is needed")
    rotation = np.stack([axes[0], axes[1], np.cross(axes[0], axes[1])])
    flat = (points - centre) @ rotation.T
    return Rigid3(rotation, -rotation @ centre), flat


def _homography(rays: Rays, flat: FloatArray, weight: FloatArray) -> FloatArray:
    """Return H (3, 3), ray ~ H (x, y, 1), signed so that the target lies along the rays."""
    scale = np.sqrt((flat[:, :2] ** 2).sum(axis=1).mean())
    target = np.concatenate([flat[:, :2] / scale, np.ones((len(flat), 1))], axis=1)
    rows = tangent_bases(rays)[:, :, :, None] * target[:, None, None, :] * weight[:, None, None, None]
    # Nine columns: only four corners (eight rows) leave the null vector out of a reduced decomposition.
    _, singular, vt = np.linalg.svd(rows.reshape(-1, 9), full_matrices=2 * len(rows) < 9)
    if singular[7] < MIN_HOMOGRAPHY_GAP * singular[0]:
        raise DegenerateError("board pose: all corners but one lie on one line; corners of two full rows are needed")
    h = vt[-1].reshape(3, 3)
    along = ((target @ h.T) * rays).sum()
    return np.asarray(h * np.sign(along) / np.array([scale, scale, 1.0]))


def _pose_from_homography(h: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return rotation and translation from H ~ [r1 r2 t]."""
    scale = np.sqrt(np.linalg.norm(h[:, 0]) * np.linalg.norm(h[:, 1]))
    if not scale > 0.0:
        raise DegenerateError("board pose: the homography has no scale; the target is seen edge-on; take another view")
    r1, r2, t = (h / scale).T
    return nearest_rotation(np.stack([r1, r2, np.cross(r1, r2)], axis=1)), t


def _both_tilts(rotation: FloatArray, translation: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the pose and its planar ambiguity, which has the same image under weak perspective: the target's axes have
    the same components perpendicular to the line of sight to its centre, and opposite ones along it."""
    sight = translation / np.linalg.norm(translation)
    axes = rotation[:, :2] - 2.0 * np.outer(sight, sight @ rotation[:, :2])
    other = np.column_stack([axes, np.cross(axes[:, 0], axes[:, 1])])
    return np.stack([rotation, other]), np.stack([translation, translation])


def after_pose_step(poses: tuple[FloatArray, ...], step: FloatArray) -> tuple[FloatArray, ...]:
    """Return poses (N, 3, 3), (N, 3) after steps (w, dt) (N, 6): R <- exp(w) R, t <- t + dt."""
    return exp_so3(step[:, :3]) @ poses[0], poses[1] + step[:, 3:]


def _differ(rotation: FloatArray, translation: FloatArray, flat: FloatArray, cost: FloatArray) -> bool:
    """Return whether the two optima are distinct: both finite, and some point differs by 0.001 of its distance."""
    if not np.isfinite(cost).all():
        return False
    moved = flat @ (rotation[0] - rotation[1]).T + (translation[0] - translation[1])
    return bool(np.abs(moved).max() > 1e-3 * np.linalg.norm(translation[0]))


def _covariance(jacobian: FloatArray, cost: float, variance: float | None) -> FloatArray:
    rows = jacobian.reshape(-1, 6)
    if variance is None:
        variance = cost / (len(rows) - 6) if len(rows) > 6 else np.nan
    _, singular, vt = np.linalg.svd(rows, full_matrices=False)
    return np.asarray((vt.T / singular**2) @ vt * variance)
