"""What the kernel of board_pose.c computes, in numpy."""

from __future__ import annotations

import numpy as np

from rigkit.core.arrays import FloatArray, Points, Rays


def point_residuals(rays: Rays, bases: FloatArray, points: Points) -> tuple[FloatArray, FloatArray]:
    """Return residuals (..., N, 2) of points in the camera frame against rays (..., N, 3), and d residual / d point."""
    length = np.linalg.norm(points, axis=-1, keepdims=True)
    u = points / length
    closeness = np.maximum(1.0 + (u * rays).sum(axis=-1), 1e-9)[..., None]
    tangent = (bases @ u[..., None])[..., 0]
    by_u = (2.0 / closeness)[..., None] * (bases - (tangent / closeness)[..., None] * rays[..., None, :])
    d_residuals_d_point = (by_u - (by_u @ u[..., None]) * u[..., None, :]) / length[..., None]
    return 2.0 * tangent / closeness, d_residuals_d_point
