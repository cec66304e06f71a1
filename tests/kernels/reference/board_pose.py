"""What the kernels of board_pose.c compute, in numpy."""

from __future__ import annotations

import numpy as np

from rigkit.core.arrays import FloatArray, Mat3, Points, Rays
from rigkit.geometry.board_pose import after_pose_step
from rigkit.geometry.rotation import skew
from rigkit.optim.batched import BatchedProblem, minimise_each
from rigkit.optim.damping import Damping, Stop


def point_residuals(rays: Rays, bases: FloatArray, points: Points) -> tuple[FloatArray, FloatArray]:
    """Return residuals (..., N, 2) of points in the camera frame against rays (..., N, 3), and d residual / d point."""
    length = np.linalg.norm(points, axis=-1, keepdims=True)
    u = points / length
    closeness = np.maximum(1.0 + (u * rays).sum(axis=-1), 1e-9)[..., None]
    tangent = (bases @ u[..., None])[..., 0]
    by_u = (2.0 / closeness)[..., None] * (bases - (tangent / closeness)[..., None] * rays[..., None, :])
    d_residuals_d_point = (by_u - (by_u @ u[..., None]) * u[..., None, :]) / length[..., None]
    return 2.0 * tangent / closeness, d_residuals_d_point


def ray_residuals(
    rays: Rays, bases: FloatArray, points: Points, rotation: Mat3, translation: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return residuals (K, N, 2) of points (N, 3) at K poses, and derivatives (K, N, 2, 6) by a turn and a shift."""
    turned = points @ np.swapaxes(rotation, 1, 2)
    residual, d_residuals_d_point = point_residuals(rays, bases, turned + translation[:, None])
    return residual, np.concatenate([-d_residuals_d_point @ skew(turned), d_residuals_d_point], axis=-1)


def refine(
    rays: Rays, bases: FloatArray, points: Points, start: tuple[Mat3, FloatArray], max_steps: int
) -> tuple[Mat3, FloatArray, FloatArray]:
    """Return the poses (K, 3, 3), (K, 3) of least squares near `start`, and their costs (K,)."""

    def linearise(poses: tuple[FloatArray, ...]) -> BatchedProblem:
        residual, jacobian = ray_residuals(rays, bases, points, *poses)
        residual, jacobian = residual.reshape(len(residual), -1), jacobian.reshape(len(residual), -1, 6)
        transposed = np.swapaxes(jacobian, 1, 2)
        descent = -(transposed @ residual[..., None])[..., 0]
        return BatchedProblem(transposed @ jacobian, descent, (residual**2).sum(axis=1))

    damping, stop = Damping(start=1e-4, floor=1e-12, ceiling=1e6), Stop(steps=max_steps)
    (rotation, translation), cost = minimise_each(start, linearise, after_pose_step, damping, stop)
    return rotation, translation, cost
