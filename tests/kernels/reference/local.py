"""What `SampsonRows` asks the kernels of pose.c for, in numpy."""

from __future__ import annotations

import numpy as np

from rigkit.core.arrays import FloatArray, IntArray, Mat3
from rigkit.geometry.rotation import cross, exp_so3, skew
from rigkit.relative_pose.refinement.local import (
    LOCAL_SETTLED_RAD,
    MAX_LOCAL_STEPS,
    SampsonRows,
    _split_essential,
    marginal_quality,
    marginal_weights,
)
from rigkit.relative_pose.solvers.pose import free_directions, rotations_and_direction, translation_basis


def residuals(rows: SampsonRows, E21: Mat3) -> FloatArray:
    return split(rows.packed, E21)[0]


def quality(rows: SampsonRows, E21: Mat3, noise: float) -> FloatArray:
    return np.asarray(marginal_quality(split(rows.packed, E21)[0], noise).sum(axis=1))


def quality_ahead(rows: SampsonRows, E21: Mat3, sigmas: float, *noise: float) -> FloatArray:
    first, second, t = rotations_and_direction(E21)
    R = np.stack([first, second], axis=1)
    f1, f2 = rows.packed[:3].T, rows.packed[3:6].T
    r, a, t = split(rows.packed, skew(t) @ first)[0], f1 @ np.swapaxes(R, 2, 3), t[:, None, None]
    across = cross(f2, a)
    range1, range2 = (np.sum(cross(t, f) * across, axis=-1) for f in (f2, a))
    far = np.sum(across**2, axis=-1) <= sigmas**2 * 0.5 * np.sum(rows.packed[6:] ** 2, axis=0)
    ahead = np.stack([far | ((sign * range1 >= 0.0) & (sign * range2 >= 0.0)) for sign in (1.0, -1.0)])
    sums = [np.sum(marginal_quality(r, level)[:, None] * ahead, axis=3) for level in noise]
    return np.asarray(np.max(sums, axis=(1, 3)))


def improved(rows: SampsonRows, E21: Mat3, kind: str, *noise: float) -> Mat3:
    R, t = _split_essential(E21, kind)
    out = np.empty((len(noise), *R.shape))
    for k, level in enumerate(noise):
        move(rows.packed, R, t, level, free_directions(kind))
        out[k] = skew(t) @ R
    return np.asarray(out * np.sqrt(0.5))


def split(packed: FloatArray, E21: Mat3) -> tuple[FloatArray, FloatArray]:
    """Return the distances in sigmas and 1 / s, (H, N); both zero at the epipoles, where any partner fits."""
    f1, f2, b1, b2 = np.split(packed, [3, 6, 12])
    line2, line1 = E21 @ f1, np.swapaxes(E21, 1, 2) @ f2
    variance = np.zeros((len(E21), packed.shape[1]))
    for line, b in ((line1, b1), (line2, b2)):
        for column in (b[:3], b[3:]):
            variance += np.sum(line * column, axis=1) ** 2
    inverse = np.divide(1.0, np.sqrt(variance), out=np.zeros_like(variance), where=variance > 0.0)
    return np.sum(line2 * f2, axis=1) * inverse, inverse


def move(packed: FloatArray, R: FloatArray, t: FloatArray, level: float, free: IntArray) -> None:
    """Move rotations (H, 3, 3) and unit directions (H, 3), in place, to the best quality at noise `level`."""
    r, inverse = split(packed, skew(t) @ R)
    quality, weights = marginal_quality(r, level), marginal_weights(r, level)
    damping = np.full(len(R), 1e-4)
    active = np.arange(len(R))
    for _ in range(MAX_LOCAL_STEPS):
        basis = translation_basis(t[active])
        J = _derivatives(packed, R[active], t[active], basis)[:, :, free] * inverse[active, :, None]
        JtW = np.swapaxes(J, 1, 2) * weights[active, None]
        gram, gradient = JtW @ J, JtW @ r[active, :, None]
        diagonal = np.einsum("hii->hi", gram)
        diagonal *= 1.0 + damping[active, None]
        diagonal += 1e-12 * diagonal.sum(axis=1, keepdims=True) + 1e-300
        step = np.zeros((len(active), 5))
        step[:, free] = -np.linalg.solve(gram, gradient)[..., 0]
        new_R = exp_so3(step[:, :3]) @ R[active]
        new_t = t[active] + np.sum(step[:, 3:, None] * basis, axis=1)
        new_t /= np.linalg.norm(new_t, axis=1, keepdims=True)
        new_r, new_inverse = split(packed, skew(new_t) @ new_R)
        new_quality = marginal_quality(new_r, level)
        better = new_quality.sum(axis=1) >= quality[active].sum(axis=1)
        took = active[better]
        R[took], t[took], r[took], inverse[took] = new_R[better], new_t[better], new_r[better], new_inverse[better]
        quality[took], weights[took] = new_quality[better], marginal_weights(new_r[better], level)
        damping[active] = np.where(better, 0.1 * damping[active], 10.0 * damping[active])
        moving = (np.abs(step).max(axis=1) > LOCAL_SETTLED_RAD) & (damping[active] < 1e8)
        active = active[moving]
        if not len(active):
            return


def _derivatives(packed: FloatArray, R: FloatArray, t: FloatArray, basis: FloatArray) -> FloatArray:
    """Return the derivatives (H, N, 5) of f2^T [t]x R f1 by R <- exp(w) R and t <- t + b1 T1 + b2 T2."""
    f1, f2 = packed[:3].T, packed[3:6].T
    turned = f1 @ np.swapaxes(R, 1, 2)
    by_rotation = cross(turned, cross(f2, t[:, None]))
    by_direction = cross(turned, f2) @ np.swapaxes(basis, 1, 2)
    return np.concatenate([by_rotation, by_direction], axis=2)
