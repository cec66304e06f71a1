"""The global optimum of the two-view pixel correction, the reference for Lindstrom's two iterations.

R. Hartley and P. Sturm, "Triangulation", CVIU 1997.
"""

from __future__ import annotations

import numpy as np

from rigkit.core.arrays import FloatArray, Mat3, Pixels


def correct_hartley_sturm(pixels1: Pixels, pixels2: Pixels, F21: Mat3) -> tuple[Pixels, Pixels]:
    """Return the nearest pixels (N, 2) that satisfy x2^T F21 x1 = 0: the global optimum of Hartley and Sturm.

    Notes
    -----
    The stationary epipolar lines are the roots of a polynomial of degree six in t. Here t = scale * tan(w), which
    makes it a trigonometric polynomial in 2w: no leading coefficient can vanish and t at infinity is an ordinary
    point. The cost is evaluated at the angles of all six roots, real or not, and at infinity, because rounding errors
    may turn a nearly double real root into a complex pair.
    """
    q1, q2 = np.asarray(pixels1, dtype=np.float64), np.asarray(pixels2, dtype=np.float64)
    u, _, vt = np.linalg.svd(F21)
    rotation1, f1, offset1 = _epipole_frame(vt[2], q1)
    rotation2, f2, offset2 = _epipole_frame(u[:, 2], q2)
    # Coordinates with the point at the origin and the epipole at (1, 0, f).
    local = rotation2 @ np.swapaxes(offset2, -1, -2) @ F21 @ offset1 @ np.swapaxes(rotation1, -1, -2)
    local = _ratio(local, np.linalg.norm(local, axis=(-2, -1), keepdims=True))
    a, b, c, d = (local[:, i, j, None] for i, j in ((1, 1), (1, 2), (2, 1), (2, 2)))
    f1, f2 = f1[:, None], f2[:, None]
    # First-order size of t: the distance from the line of the other image through the epipole.
    scale = np.abs(_ratio(d, np.sqrt(b * b + c * c + (f2 * d) ** 2))) + 1e-12

    def lines(t: FloatArray, s: FloatArray) -> tuple[FloatArray, FloatArray]:
        return a * t + b * s, c * t + d * s

    sample = np.arange(7) * (np.pi / 7.0)
    t, s = scale * np.sin(sample), np.cos(sample)[None]
    p, q = lines(t, s)
    g = t * s * (p**2 + (f2 * q) ** 2) ** 2 - (a * d - b * c) * (s**2 + (f1 * t) ** 2) ** 2 * p * q
    angle = _roots_on_circle(g)
    angle = np.concatenate([angle, np.full((len(q1), 1), 0.5 * np.pi)], axis=1)
    t, s = scale * np.sin(angle), np.cos(angle)
    p, q = lines(t, s)
    cost = _ratio(t**2, s**2 + (f1 * t) ** 2) + _ratio(q**2, p**2 + (f2 * q) ** 2)
    best = np.argmin(cost, axis=1)[:, None]
    t, s = np.take_along_axis(t, best, 1), np.take_along_axis(s, best, 1)
    p, q = lines(t, s)
    foot1 = _foot(np.concatenate([t * f1, s, -t], axis=1))
    foot2 = _foot(np.concatenate([-f2 * q, p, q], axis=1))
    out1 = (np.swapaxes(rotation1[:, :2, :2], -1, -2) @ foot1[..., None])[..., 0] + q1
    out2 = (np.swapaxes(rotation2[:, :2, :2], -1, -2) @ foot2[..., None])[..., 0] + q2
    # On an epipole every partner satisfies the constraint: no correction.
    keep = ~np.isfinite(np.concatenate([out1, out2], axis=1)).all(axis=1, keepdims=True)
    return np.where(keep, q1, out1), np.where(keep, q2, out2)


def _ratio(a: FloatArray, b: FloatArray) -> FloatArray:
    """Return a / b, zero where b is zero."""
    a, b = np.broadcast_arrays(a, b)
    return np.divide(a, b, out=np.zeros(a.shape), where=b != 0.0)


def _epipole_frame(epipole: FloatArray, pixels: Pixels) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return rotations (N, 3, 3) that bring the epipole to (1, 0, f) with each pixel at the origin, f, and shifts."""
    shift = np.broadcast_to(np.eye(3), (len(pixels), 3, 3)).copy()
    shift[:, :2, 2] = pixels
    moved = epipole[:2] - pixels * epipole[2]
    length = np.linalg.norm(moved, axis=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        direction = moved / length[:, None]
        f = epipole[2] / length
    bad = ~np.isfinite(direction).all(axis=1) | ~np.isfinite(f)
    direction[bad], f[bad] = [1.0, 0.0], np.nan
    rotation = np.zeros((len(pixels), 3, 3))
    rotation[:, 0, :2] = direction
    rotation[:, 1, 0], rotation[:, 1, 1] = -direction[:, 1], direction[:, 0]
    rotation[:, 2, 2] = 1.0
    return rotation, f, shift


def _roots_on_circle(samples: FloatArray) -> FloatArray:
    """Return the angles w (N, 6) of the roots z = exp(2iw) of trigonometric polynomials sampled at k pi / 7."""
    coefficients = np.fft.fft(np.nan_to_num(samples), axis=1) / 7.0
    # Frequencies -3 .. 3 of exp(2iw), highest first.
    poly = coefficients[:, [3, 2, 1, 0, 6, 5, 4]]
    size = np.abs(poly).max(axis=1, keepdims=True)
    lead = poly[:, :1]
    lead = np.where(np.abs(lead) > 1e-13 * size, lead, 1e-13 * size + (size == 0.0))
    companion = np.zeros((len(poly), 6, 6), dtype=complex)
    companion[:, np.arange(1, 6), np.arange(5)] = 1.0
    companion[:, 0, :] = -poly[:, 1:] / lead
    return np.asarray(0.5 * np.angle(np.linalg.eigvals(companion)))


def _foot(line: FloatArray) -> FloatArray:
    """Return the point (N, 2) of each line (N, 3) nearest to the origin."""
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(-line[:, :2] * line[:, 2:] / np.sum(line[:, :2] ** 2, axis=1, keepdims=True))
