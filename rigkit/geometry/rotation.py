"""Rotations: exponential map, logarithm, skew matrices, all batched."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from rigkit.core.arrays import FloatArray, Mat3


def skew(v: FloatArray) -> Mat3:
    """Return the matrix [v]x with [v]x w = v x w. `v` (..., 3) -> (..., 3, 3)."""
    v = np.asarray(v, dtype=np.float64)
    out = np.zeros((*v.shape[:-1], 3, 3))
    out[..., 0, 1], out[..., 0, 2], out[..., 1, 2] = -v[..., 2], v[..., 1], -v[..., 0]
    out[..., 1, 0], out[..., 2, 0], out[..., 2, 1] = v[..., 2], -v[..., 1], v[..., 0]
    return out


def cross(a: FloatArray, b: FloatArray) -> FloatArray:
    """Return a x b of `a` and `b` (..., 3), much faster than np.cross."""
    a0, a1, a2 = a[..., 0], a[..., 1], a[..., 2]
    b0, b1, b2 = b[..., 0], b[..., 1], b[..., 2]
    return np.stack([a1 * b2 - a2 * b1, a2 * b0 - a0 * b2, a0 * b1 - a1 * b0], axis=-1)


def exp_so3(rotation_vector: ArrayLike) -> Mat3:
    """Return the rotation by |w| radians about w. `rotation_vector` (..., 3) -> (..., 3, 3), exact at zero."""
    w = np.asarray(rotation_vector, dtype=np.float64)
    # Both coefficients are exact down to the smallest angle: (1 - cos a) / a^2 = 2 (sin(a / 2) / a)^2.
    angle = np.maximum(np.sqrt((w * w).sum(axis=-1)), np.finfo(float).tiny)[..., None, None]
    k = skew(w)
    first = np.sin(angle) / angle
    second = 2.0 * (np.sin(0.5 * angle) / angle) ** 2
    return np.asarray(np.eye(3) + first * k + second * (k @ k))


def left_jacobian(rotation_vector: ArrayLike) -> Mat3:
    """Return the matrix J (3, 3) with exp(w + dw) = exp(J dw) exp(w) at first order, of a rotation vector w (3,)."""
    w = np.asarray(rotation_vector, dtype=np.float64)
    angle, k = float(np.linalg.norm(w)), skew(w)
    second = 2.0 * (np.sin(0.5 * angle) / angle) ** 2 if angle > 0.0 else 0.5
    # (a - sin a) / a^3 loses digits at small angles, where the series is exact.
    third = (angle - np.sin(angle)) / angle**3 if angle > 0.1 else (1.0 - angle**2 / 20.0 + angle**4 / 840.0) / 6.0
    return np.asarray(np.eye(3) + second * k + third * (k @ k))


def log_so3(rotation: Mat3) -> FloatArray:
    """Return the rotation vector (radians, norm in [0, pi]) of `rotation` (..., 3, 3)."""
    r = np.asarray(rotation, dtype=np.float64)
    vee = 0.5 * np.stack(
        [r[..., 2, 1] - r[..., 1, 2], r[..., 0, 2] - r[..., 2, 0], r[..., 1, 0] - r[..., 0, 1]], axis=-1
    )
    sine = np.linalg.norm(vee, axis=-1)
    cosine = 0.5 * (np.trace(r, axis1=-2, axis2=-1) - 1.0)
    angle = np.arctan2(sine, cosine)
    scale = np.where(sine > 1e-12, angle / np.where(sine > 1e-12, sine, 1.0), 1.0)
    out = vee * scale[..., None]
    near_pi = (cosine < 0.0) & (sine < 1e-6)
    if np.any(near_pi):
        # The antisymmetric part vanishes at pi; the axis is the largest column of R + I.
        sym = 0.5 * (r + np.swapaxes(r, -1, -2)) + np.eye(3)
        column = np.argmax(np.linalg.norm(sym, axis=-2), axis=-1)
        axis = np.take_along_axis(sym, column[..., None, None], axis=-1)[..., 0]
        axis = unit(axis)
        sign = np.where(np.sum(axis * vee, axis=-1) < 0.0, -1.0, 1.0)
        out = np.where(near_pi[..., None], axis * (sign * angle)[..., None], out)
    return np.asarray(out)


def nearest_rotation(matrix: Mat3) -> Mat3:
    """Return the rotation nearest to `matrix` (..., 3, 3) in the Frobenius norm."""
    u, _, vt = np.linalg.svd(matrix)
    flip = np.ones((*u.shape[:-2], 3))
    flip[..., 2] = np.sign(np.linalg.det(u @ vt))
    return np.asarray((u * flip[..., None, :]) @ vt)


def rotation_angle(rotation: Mat3) -> FloatArray:
    """Return the angle of `rotation` (..., 3, 3) in radians, in [0, pi], accurate for small angles."""
    return np.asarray(np.linalg.norm(log_so3(rotation), axis=-1))


def unit(v: FloatArray) -> FloatArray:
    """Return `v` (..., k) scaled to length 1; NaN where the length is zero."""
    v = np.asarray(v, dtype=np.float64)
    # np.sum along so short an axis takes several times as long.
    squares = v * v
    length = np.sqrt(sum((squares[..., k] for k in range(1, v.shape[-1])), start=squares[..., 0]))[..., None]
    return np.asarray(v / np.where(length > 0.0, length, np.nan))


def angle_between(a: FloatArray, b: FloatArray) -> FloatArray:
    """Return the angle in radians between vectors (..., 3), accurate near 0 and pi (atan2, not acos)."""
    a, b = np.asarray(a, dtype=np.float64), np.asarray(b, dtype=np.float64)
    return np.asarray(np.arctan2(np.linalg.norm(cross(a, b), axis=-1), np.sum(a * b, axis=-1)))
