"""Compute directions on whole board lattices, batched over trials: the paper's chords, or exact derivatives."""

from __future__ import annotations

import numpy as np

from rigkit.core.arrays import FloatArray, Pixels


def chord_directions(lattice: Pixels) -> FloatArray:
    """Return the chords to the neighbour along the columns, the rows and the diagonal, (..., rows, columns, 3, 2).

    The last column and row use the chord from the previous neighbour, so that all point the same way. Chords have the
    right direction but a biased length, because of perspective. The two corners without a diagonal neighbour get the
    sum of their other two (exact) derivatives.

    Parameters
    ----------
    lattice : (..., rows, columns, 2) corners of a perspective image, px; three rows and columns at least.
    """
    horizontal = _forward_differences(lattice, -2)
    vertical = _forward_differences(lattice, -3)
    diagonal = np.empty_like(lattice)
    step = lattice[..., 1:, 1:, :] - lattice[..., :-1, :-1, :]
    diagonal[..., :-1, :-1, :] = step
    diagonal[..., 1:, -1, :] = step[..., :, -1, :]
    diagonal[..., -1, 1:, :] = step[..., -1, :, :]
    exact = harmonic_directions(lattice)[..., 2, :]
    for row, column in ((0, -1), (-1, 0)):
        diagonal[..., row, column, :] = exact[..., row, column, :]
    return np.stack([horizontal, vertical, diagonal], axis=-2)


def harmonic_directions(lattice: Pixels) -> FloatArray:
    """Return the exact derivatives along columns, rows and diagonal, per square, (..., rows, columns, 3, 2).

    Notes
    -----
    In perspective a line is x(s) = a s / (1 + c s), so the derivative's length is the harmonic mean of the chords to
    both neighbours, or l1 l2 / (2 (l2 - l1)) from the distances to the next two at a border. The diagonal's derivative
    is the sum of the other two.
    """
    horizontal, vertical = _harmonic(lattice, -2), _harmonic(lattice, -3)
    return np.stack([horizontal, vertical, horizontal + vertical], axis=-2)


def _forward_differences(lattice: Pixels, axis: int) -> FloatArray:
    step = np.diff(lattice, axis=axis)
    return np.concatenate([step, np.take(step, [-1], axis=axis)], axis=axis)


def _harmonic(lattice: Pixels, axis: int) -> FloatArray:
    points = np.moveaxis(lattice, axis, 0)
    step = np.diff(points, axis=0)
    length = np.linalg.norm(step, axis=-1, keepdims=True)
    out = np.empty_like(points)
    behind, ahead = length[:-1], length[1:]
    across = points[2:] - points[:-2]
    out[1:-1] = across / np.linalg.norm(across, axis=-1, keepdims=True) * (2.0 * behind * ahead / (behind + ahead))
    for end, near, far in ((0, 1, 2), (-1, -2, -3)):
        to_near, to_far = points[near] - points[end], points[far] - points[end]
        l1, l2 = (np.linalg.norm(v, axis=-1, keepdims=True) for v in (to_near, to_far))
        sign = 1.0 if end == 0 else -1.0
        # 1 / x(1) - 1 / x(2) = 1 / (2 a), and a is the slope at s = 0.
        out[end] = sign * to_far / l2 * (l1 * l2 / (2.0 * (l2 - l1)))
    return np.moveaxis(out, 0, axis)
