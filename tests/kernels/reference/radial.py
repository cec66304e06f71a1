"""What the kernels of radial.c compute, in numpy.

pixel = L radius (x, y) / r + centre, with the radius in the image from r = |(x, y)| and z.
"""

from __future__ import annotations

import numpy as np

from rigkit.core.arrays import BoolArray, FloatArray

BISECTIONS = 200
Derivatives = tuple[FloatArray, BoolArray, FloatArray, FloatArray]
"""Pixels (N, 2), valid (N,), and the derivatives by points (N, 2, 3) and by parameters (N, 2, P)."""


def kannala_brandt(points: FloatArray, shape: FloatArray, linear: FloatArray, max_angle: float) -> Derivatives:
    """Parameters are fx, fy, cx, cy, k1 ... k4."""
    r, z = np.hypot(points[:, 0], points[:, 1]), points[:, 2]
    theta, length2 = np.arctan2(r, z), r * r + z * z
    powers = theta ** np.arange(3, 11, 2)[:, None]
    slope = 1.0 + shape @ (np.arange(3, 11, 2)[:, None] * powers / theta)
    radius = theta + shape @ powers
    pixels, d_pixels_d_point, along = _differentiated(points, linear, radius, slope * z / length2, -slope * r / length2)
    d_pixels_d_parameters = np.zeros((len(points), 2, 8))
    d_pixels_d_parameters[:, [0, 1], [0, 1]] = radius[:, None] * points[:, :2] / r[:, None]
    d_pixels_d_parameters[:, [0, 1], [2, 3]] = 1.0
    d_pixels_d_parameters[:, :, 4:] = along[:, :, None] * powers.T[:, None]
    return pixels, theta <= max_angle, d_pixels_d_point, d_pixels_d_parameters


def scaramuzza(points: FloatArray, polynomial: FloatArray, linear: FloatArray, max_radius: float) -> Derivatives:
    """Parameters are a0, a2 ... aN, cx, cy, c, d; `polynomial` is f with its a1 = 0. The radius solves z rho = r f."""
    r, z = np.hypot(points[:, 0], points[:, 1]), points[:, 2]
    valid = np.arctan2(r, z) <= np.arctan2(max_radius, np.polyval(polynomial[::-1], max_radius))
    low, high = np.zeros(len(r)), np.full(len(r), max_radius)
    for _ in range(BISECTIONS):
        radius = 0.5 * (low + high)
        inside = z * radius < r * np.polyval(polynomial[::-1], radius)
        low, high = np.where(inside, radius, low), np.where(inside, high, radius)
    f, slope = np.polyval(polynomial[::-1], radius), np.polyval(np.polyder(polynomial[::-1]), radius)
    # z d rho + rho dz = f dr + r f' d rho + r rho^k d a_k.
    by_rho = z - r * slope
    pixels, d_pixels_d_point, along = _differentiated(points, linear, radius, f / by_rho, -radius / by_rho)
    n = len(polynomial) - 1
    d_pixels_d_parameters = np.zeros((len(points), 2, n + 4))
    powers = radius ** np.array([0, *range(2, n + 1)])[:, None] * (r / by_rho)
    d_pixels_d_parameters[:, :, :n] = along[:, :, None] * powers.T[:, None]
    d_pixels_d_parameters[:, [0, 1], [n, n + 1]] = 1.0
    d_pixels_d_parameters[:, 0, n + 2 :] = radius[:, None] * points[:, :2] / r[:, None]
    return pixels, valid, d_pixels_d_point, d_pixels_d_parameters


def _differentiated(
    points: FloatArray, linear: FloatArray, radius: FloatArray, by_r: FloatArray, by_z: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return pixels, their derivatives by the points, and L (x, y) / r (N, 2): theirs by the radius."""
    l00, l01, l11, cx, cy = linear
    L = np.array([[l00, l01], [0.0, l11]])
    r = np.hypot(points[:, 0], points[:, 1])
    towards = points[:, :2] / r[:, None]
    across = np.eye(2) - towards[:, :, None] * towards[:, None]
    by_xy = (radius / r)[:, None, None] * across + by_r[:, None, None] * towards[:, :, None] * towards[:, None]
    d_pixels_d_point = np.concatenate([L @ by_xy, (towards @ L.T * by_z[:, None])[:, :, None]], axis=-1)
    return radius[:, None] * (towards @ L.T) + [cx, cy], d_pixels_d_point, towards @ L.T
