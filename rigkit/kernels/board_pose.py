"""The kernels in board_pose.c: residuals of the points of a rigid board against rays, and the poses that minimise."""

from __future__ import annotations

import numpy as np

from rigkit.core.arrays import FloatArray, Mat3, Points, Rays
from rigkit.kernels import kernels


def ray_residuals(
    rays: Rays, bases: FloatArray, points: Points, rotation: Mat3, translation: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return residuals (K, N, 2) of points (N, 3) at poses (K, 3, 3), (K, 3), and their derivatives (K, N, 2, 6) by
    rotation and translation, for rays (S, N, 3) with bases (S, N, 2, 3): S is K, or 1 for all poses."""
    residuals, jacobian = kernels().ray_residuals(rays, bases, points, rotation, translation)
    return residuals, jacobian


def refine(
    rays: Rays,
    bases: FloatArray,
    points: Points,
    rotation: Mat3,
    translation: FloatArray,
    max_steps: int,
    tolerance: float,
) -> tuple[Mat3, FloatArray, FloatArray]:
    """Return poses (K, 3, 3), (K, 3) each at the minimum near it, and their costs (K,), sums of squared residuals.

    `max_steps` are tried at most; one of less than `tolerance`, in radians and parts of the distance, is the last. Else
    as `ray_residuals`.
    """
    R, t = np.array(rotation, np.float64, order="C"), np.array(translation, np.float64, order="C")
    return R, t, kernels().refine_board_poses(rays, bases, points, R, t, max_steps, tolerance)
