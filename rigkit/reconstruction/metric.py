"""From a pose of unit baseline to millimetres: the scale from the boards, and the uncertainty of everything metric."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from rigkit.core.arrays import BoolArray, FloatArray, Points
from rigkit.core.boards import Board
from rigkit.core.matches import Matches
from rigkit.geometry.rigid3 import Rigid3
from rigkit.geometry.rotation import exp_so3, unit
from rigkit.geometry.triangulation import point_covariances, triangulate_rays
from rigkit.reconstruction.scale import scale_and_gradient
from rigkit.relative_pose.solvers.pose import translation_basis

POSE_STEP_RAD = 1e-5
"""For central differences: far above rounding, far below where the scale bends."""


@dataclass(frozen=True, eq=False, slots=True)
class MetricPose:
    """A relative pose in mm.

    Attributes
    ----------
    cam2_from_cam1 : metric pose.
    covariance : (6, 6) of (left rotation perturbation rad, translation mm), the scale's uncertainty included.
    baseline_mm, baseline_sigma_mm : length of the translation; sigma from corners, pose, and the squares' own sigma.
    """

    cam2_from_cam1: Rigid3
    covariance: FloatArray
    baseline_mm: float
    baseline_sigma_mm: float


class TriangulatedPoints(NamedTuple):
    """Points (N, 3) in the frame of camera 1, their covariances (N, 3, 3), and which of them (N,) are valid."""

    points: Points
    covariance: FloatArray
    valid: BoolArray


def triangulate_matches(
    matches: Matches, cam2_from_cam1: Rigid3, pose_covariance: FloatArray | None = None
) -> TriangulatedPoints:
    """Intersect the rays of all matches.

    The unit is that of the pose's translation. See `point_covariances` for the pose's share.
    """
    m = matches
    points, valid = _points(matches, cam2_from_cam1)
    covariance = point_covariances(
        points,
        cam2_from_cam1,
        m.rays1,
        m.rays2,
        m.jacobians1,
        m.jacobians2,
        m.sigma1_px,
        m.sigma2_px,
        pose_covariance,
    )
    return TriangulatedPoints(points, covariance, valid)


def _points(m: Matches, cam2_from_cam1: Rigid3) -> tuple[Points, BoolArray]:
    points, valid = triangulate_rays(
        m.rays1,
        m.rays2,
        cam2_from_cam1,
        jacobians1=m.jacobians1,
        jacobians2=m.jacobians2,
        sigma1_px=m.sigma1_px,
        sigma2_px=m.sigma2_px,
    )
    return np.where(valid[:, None], points, np.nan), valid


def metric_pose(
    matches: Matches, cam2_from_cam1: Rigid3, pose_covariance: FloatArray, boards: Sequence[Board]
) -> MetricPose:
    """Return the pose in mm: rotation and direction stay, the length comes from the boards' squares.

    Parameters
    ----------
    matches : `board_index` and `grid` say which corner each is.
    cam2_from_cam1, pose_covariance : of unit baseline, as from the refinement.
    boards : in the order of `board_index`.

    Raises
    ------
    DegenerateError
        No board has enough triangulated corners.

    Notes
    -----
    Var(s) = Var(s | pose) + g C g^T with g the derivative of the scale by the pose: the corners' noise splits into a
    part that moves the pose and, independent of it, a part that moves the points at fixed pose.
    """
    R, t = cam2_from_cam1.rotation, unit(cam2_from_cam1.translation_mm)
    points, covariance, _ = triangulate_matches(matches, Rigid3(R, t))

    def points_at(step: FloatArray) -> Points:
        return _points(matches, Rigid3(exp_so3(step[:3]) @ R, unit(t + step[3:])))[0]

    scale, sigma, d_scale_d_points = scale_and_gradient(points, matches.board_index, matches.grid, boards, covariance)
    directions = np.zeros((5, 6))
    directions[:3, :3], directions[3:, 3:] = np.eye(3), translation_basis(t)
    by_direction = []
    for d in directions:
        motion = (points_at(POSE_STEP_RAD * d) - points_at(-POSE_STEP_RAD * d)) / (2.0 * POSE_STEP_RAD)
        # A point without a triangulation takes no part.
        by_direction.append(float(np.sum(d_scale_d_points * np.nan_to_num(motion))))
    gradient = np.array(by_direction) @ directions
    to_metric = np.zeros((6, 6))
    to_metric[:3, :3] = np.eye(3)
    to_metric[3:] = np.outer(t, gradient)
    to_metric[3:, 3:] += scale * np.eye(3)
    full = to_metric @ pose_covariance @ to_metric.T
    full[3:, 3:] += sigma**2 * np.outer(t, t)
    baseline_sigma = float(np.sqrt(sigma**2 + gradient @ pose_covariance @ gradient))
    return MetricPose(Rigid3(R, scale * t), full, scale, baseline_sigma)
