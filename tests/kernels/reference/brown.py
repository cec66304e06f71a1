"""What the kernel of brown.c computes, in numpy."""

from __future__ import annotations

import numpy as np

from rigkit.core.arrays import BoolArray, FloatArray


def derivatives(
    points: FloatArray, parameters: FloatArray, max_r: float
) -> tuple[FloatArray, BoolArray, FloatArray, FloatArray]:
    """Return pixels (N, 2), valid (N,) and the derivatives by points (N, 2, 3) and by parameters (N, 2, P), by the
    chain rule from m(x, y) = L(t) (x, y) + tangential with L = A / B."""
    fx, fy, cx, cy, k1, k2, p1, p2, k3, k4, k5, k6 = np.concatenate([parameters, np.zeros(12 - parameters.size)])
    x, y, z = points[:, 0] / points[:, 2], points[:, 1] / points[:, 2], points[:, 2]
    t = x * x + y * y
    powers = np.stack([t, t**2, t**3])
    a, b = 1.0 + np.tensordot([k1, k2, k3], powers, 1), 1.0 + np.tensordot([k4, k5, k6], powers, 1)
    by_t = np.stack([np.ones_like(t), 2.0 * t, 3.0 * t**2])
    slope = (np.tensordot([k1, k2, k3], by_t, 1) - a / b * np.tensordot([k4, k5, k6], by_t, 1)) / b
    plane = np.stack([x, y], axis=-1)
    bent = np.stack([2 * p1 * x * y + p2 * (t + 2 * x * x), p1 * (t + 2 * y * y) + 2 * p2 * x * y], axis=-1)
    focal = np.array([fx, fy])
    pixels = focal * ((a / b)[:, None] * plane + bent) + [cx, cy]
    cross = 2.0 * p1 * x + 2.0 * p2 * y
    by_plane = np.stack([2 * p1 * y + 6 * p2 * x, cross, cross, 6 * p1 * y + 2 * p2 * x], axis=-1).reshape(-1, 2, 2)
    by_plane += (a / b)[:, None, None] * np.eye(2) + 2.0 * slope[:, None, None] * plane[:, :, None] * plane[:, None]
    rays = np.stack([1.0 / z, 0.0 * z, -x / z, 0.0 * z, 1.0 / z, -y / z], axis=-1).reshape(-1, 2, 3)
    d_pixels_d_point = focal[:, None] * (by_plane @ rays)
    d_pixels_d_parameters = np.zeros((len(t), 2, 12))
    d_pixels_d_parameters[:, [0, 1], [0, 1]] = (pixels - [cx, cy]) / focal
    d_pixels_d_parameters[:, [0, 1], [2, 3]] = 1.0
    d_pixels_d_parameters[:, :, 6] = focal * np.stack([2 * x * y, t + 2 * y * y], axis=-1)
    d_pixels_d_parameters[:, :, 7] = focal * np.stack([t + 2 * x * x, 2 * x * y], axis=-1)
    for power, top, bottom in zip(powers, (4, 5, 8), (9, 10, 11), strict=True):
        d_pixels_d_parameters[:, :, top] = focal * plane * (power / b)[:, None]
        d_pixels_d_parameters[:, :, bottom] = -(a / b)[:, None] * d_pixels_d_parameters[:, :, top]
    return pixels, (z > 0.0) & (t <= max_r**2), d_pixels_d_point, d_pixels_d_parameters[..., : parameters.size]
