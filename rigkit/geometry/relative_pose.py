"""The relative pose of two cameras from their poses, and its covariance."""

from __future__ import annotations

import numpy as np

from rigkit.core.arrays import FloatArray
from rigkit.geometry.rigid3 import Rigid3
from rigkit.geometry.rotation import skew


def relative_pose(cam1_from_world: Rigid3, cam2_from_world: Rigid3) -> Rigid3:
    """Return cam2_from_cam1."""
    return cam2_from_world @ cam1_from_world.inverse()


def relative_pose_jacobian(cam1_from_world: Rigid3, cam2_from_world: Rigid3) -> FloatArray:
    """Return the derivative (6, 12) of cam2_from_cam1 by both poses.

    Every pose is perturbed as R' = exp([w]x) R, t' = t + v, in the order (w, v), rad and mm; camera 1 first.

    Notes
    -----
    With R = R2 R1^T and t = t2 - R t1:  w = w2 - R w1,  v = v2 - R v1 + [R t1]x w.
    """
    rotation = relative_pose(cam1_from_world, cam2_from_world).rotation
    by_both = np.zeros((6, 12))
    by_both[:3, 0:3], by_both[:3, 6:9] = -rotation, np.eye(3)
    by_both[3:] = skew(rotation @ cam1_from_world.translation_mm) @ by_both[:3]
    by_both[3:, 3:6], by_both[3:, 9:12] = -rotation, np.eye(3)
    return by_both


def relative_pose_covariance(cam1_from_world: Rigid3, cam2_from_world: Rigid3, covariance: FloatArray) -> FloatArray:
    """Return the (6, 6) covariance of cam2_from_cam1 from the joint (12, 12) one of both poses, perturbed as in
    `relative_pose_jacobian`."""
    by_both = relative_pose_jacobian(cam1_from_world, cam2_from_world)
    return np.asarray(by_both @ covariance @ by_both.T)
