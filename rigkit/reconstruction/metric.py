"""Scale a pose of unit baseline to mm by the boards' squares, and propagate the uncertainty."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from rigkit.core.arrays import BoolArray, FloatArray, Points
from rigkit.core.boards import Board
from rigkit.core.matches import Matches
from rigkit.core.printing import brief
from rigkit.geometry.rigid3 import Rigid3
from rigkit.geometry.rotation import unit
from rigkit.geometry.triangulation import point_uncertainty, triangulate_rays
from rigkit.reconstruction.scale import metric_scale


@dataclass(frozen=True, eq=False, slots=True)
class MetricPose:
    """A relative pose in mm.

    Attributes
    ----------
    cam2_from_cam1 : metric pose.
    covariance : (6, 6) of (left rotation perturbation rad, translation mm), with the scale's uncertainty.
    baseline_mm, baseline_sigma_mm : length of the translation and its standard deviation, from corners, pose and
        squares.
    """

    cam2_from_cam1: Rigid3
    covariance: FloatArray
    baseline_mm: float
    baseline_sigma_mm: float

    __repr__ = brief


class TriangulatedPoints(NamedTuple):
    """Points (N, 3) in the frame of camera 1, their covariances (N, 3, 3), and a mask (N,) of the valid ones."""

    points: Points
    covariance: FloatArray
    valid: BoolArray


def triangulate_matches(
    matches: Matches, cam2_from_cam1: Rigid3, pose_covariance: FloatArray | None = None
) -> TriangulatedPoints:
    """Triangulate all matches, in the unit of the pose's translation.

    With `pose_covariance` (6, 6) the covariances include the pose's uncertainty, see `point_uncertainty`.
    """
    points, valid, covariance, by_pose = _uncertain_points(matches, cam2_from_cam1)
    if pose_covariance is not None:
        covariance = covariance + by_pose @ pose_covariance @ np.swapaxes(by_pose, -1, -2)
    return TriangulatedPoints(points, covariance, valid)


def _uncertain_points(m: Matches, cam2_from_cam1: Rigid3) -> tuple[Points, BoolArray, FloatArray, FloatArray]:
    """Return points (N, 3), NaN if not valid, the mask (N,) of valid ones, and their `point_uncertainty`."""
    seen, sigmas = (m.rays1, m.rays2), {"sigma1_px": m.sigma1_px, "sigma2_px": m.sigma2_px}
    points, valid = triangulate_rays(*seen, cam2_from_cam1, jacobians1=m.jacobians1, jacobians2=m.jacobians2, **sigmas)
    points = np.where(valid[:, None], points, np.nan)
    return points, valid, *point_uncertainty(points, cam2_from_cam1, *seen, m.jacobians1, m.jacobians2, **sigmas)


def metric_pose(
    matches: Matches, cam2_from_cam1: Rigid3, pose_covariance: FloatArray, boards: Sequence[Board]
) -> MetricPose:
    """Return the pose with its translation scaled to mm by the boards' squares.

    Raises DegenerateError if no board has enough triangulated corners.

    Parameters
    ----------
    matches : `board_index` and `grid` identify the corners.
    cam2_from_cam1, pose_covariance : refined pose of unit baseline.
    boards : in the order of `board_index`.

    Notes
    -----
    Var(s) = Var(s | pose) + g C g^T, with g the derivative of the scale by the pose. The corners' noise has two
    independent parts: one changes the pose, the other the points at a fixed pose.
    """
    R, t = cam2_from_cam1.rotation, unit(cam2_from_cam1.translation_mm)
    points, _, covariance, by_pose = _uncertain_points(matches, Rigid3(R, t))
    scale, sigma, d_scale_d_points = metric_scale(points, matches.board_index, matches.grid, boards, covariance)
    # Points that could not be triangulated have a zero gradient.
    gradient = np.einsum("ni,nip->p", d_scale_d_points, np.nan_to_num(by_pose))
    full = covariance_in_mm(t, pose_covariance, scale, sigma, gradient)
    baseline_sigma = float(np.sqrt(sigma**2 + gradient @ pose_covariance @ gradient))
    return MetricPose(Rigid3(R, scale * t), full, scale, baseline_sigma)


def covariance_in_mm(
    t: FloatArray, pose_covariance: FloatArray, scale: float, scale_sigma: float, d_scale_d_pose: FloatArray
) -> FloatArray:
    """Return the covariance (6, 6) of a pose in mm from that of the pose with unit translation `t` (3,), and its scale.

    `scale_sigma` is the scale's standard deviation at a fixed pose, `d_scale_d_pose` (6,) its derivative by the pose.
    """
    to_metric = np.diag([1.0] * 3 + [scale] * 3)
    to_metric[3:] += np.outer(t, d_scale_d_pose)
    full = to_metric @ pose_covariance @ to_metric.T
    full[3:, 3:] += scale_sigma**2 * np.outer(t, t)
    return np.asarray(full)
