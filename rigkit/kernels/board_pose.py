"""The kernel in board_pose.c: how far the points of a rigid board lie from rays."""

from __future__ import annotations

from rigkit.core.arrays import FloatArray, Mat3, Points, Rays
from rigkit.kernels import kernels


def ray_residuals(
    rays: Rays, bases: FloatArray, points: Points, rotation: Mat3, translation: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return residuals (K, N, 2) of points (N, 3) at poses (K, 3, 3), (K, 3), and their derivatives (K, N, 2, 6) by a
    turn and a shift, against rays (S, N, 3) with bases (S, N, 2, 3): S is K, or 1 for all poses."""
    residuals, jacobian = kernels().ray_residuals(rays, bases, points, rotation, translation)
    return residuals, jacobian
