"""What kernels/planes.c computes, in numpy: all nodes at once, a neighbour after the other."""

from __future__ import annotations

import numpy as np


def fitted_planes(
    values: np.ndarray,
    information: np.ndarray,
    frames: np.ndarray,
    *,
    offsets: np.ndarray,
    windows: np.ndarray,
    step: float,
    reach: int,
    rounds: int,
    turn: float,
) -> tuple[np.ndarray, ...]:
    """Return planes (R, C, 3), normal matrices (R, C, 3, 3), sums of weights and of weighted squares (R, C), and of a
    curvature the rest of the normal matrix (R, C, 3, 3), twice, and the right side (R, C, 3)."""
    valid = np.isfinite(values[..., 0])
    F, z = np.nan_to_num(frames), np.nan_to_num(values)
    W = np.where(valid[..., None, None], information, np.eye(3))
    weighted = np.swapaxes(F, -1, -2) @ W
    own, own_right = weighted @ F, (weighted @ z[..., None])[..., 0]
    plane, spread = solved(own, own_right, valid)
    size = np.einsum("...i,...ij,...j->...", z, W, z)
    normal, support, squares = own, np.zeros(valid.shape), np.zeros(valid.shape)
    for k in range(rounds):
        normal, right = np.zeros_like(own), np.zeros_like(own_right)
        support, squares = np.zeros(valid.shape), np.zeros(valid.shape)
        for dv in range(-reach, reach + 1):
            for du in range(-reach, reach + 1):
                here, there = shifted(valid.shape, dv, du)
                miss = z[there] - (F[there] @ plane[here][..., None])[..., 0]
                inner = W[there]
                if k == 0:
                    doubt = F[there] @ np.nan_to_num(spread[here]) @ np.swapaxes(F[there], -1, -2)
                    inner = np.linalg.inv(np.linalg.inv(inner) + doubt)
                square = np.einsum("...i,...ij,...j->...", miss, inner, miss)
                weight = np.where(valid[there] & valid[here], 1.0 / (1.0 + square / (3.0 * turn**2)) ** 2, 0.0)
                normal[here] += weight[..., None, None] * own[there]
                right[here] += weight[..., None] * own_right[there]
                support[here] += weight
                squares[here] += weight * size[there]
        before = plane
        plane, spread = solved(normal, right, valid)
    squares -= np.sum(right * plane, axis=-1)
    mixed, bends, pull = np.zeros_like(own), np.zeros_like(own), np.zeros_like(own_right)
    for dv in range(-reach, reach + 1):
        for du in range(-reach, reach + 1):
            here, there = shifted(valid.shape, dv, du)
            miss = z[there] - (F[there] @ np.nan_to_num(before[here])[..., None])[..., 0]
            square = np.einsum("...i,...ij,...j->...", miss, W[there], miss)
            weight = np.where(valid[there] & valid[here], 1.0 / (1.0 + square / (3.0 * turn**2)) ** 2, 0.0)
            Q = by_curvature(step * np.array([du, dv]) - offsets[here], offsets[there], windows[there])
            turned = np.swapaxes(Q, -1, -2) @ W[there]
            mixed[here] += weight[..., None, None] * (weighted[there] @ Q)
            bends[here] += weight[..., None, None] * (turned @ Q)
            pull[here] += weight[..., None] * (turned @ miss[..., None])[..., 0]
    # The weights are those of the fit, by the plane before; the right side is at the plane after.
    pull -= (np.swapaxes(mixed, -1, -2) @ np.nan_to_num(plane - before)[..., None])[..., 0]
    of_curvature = [np.where(valid.reshape(*valid.shape, *[1] * (v.ndim - 2)), v, np.nan) for v in (mixed, bends, pull)]
    return (
        plane,
        np.where(valid[..., None, None], normal, np.nan),
        np.where(valid, support, np.nan),
        np.where(valid, squares, np.nan),
        *of_curvature,
    )


def by_curvature(d: np.ndarray, offset: np.ndarray, window: np.ndarray) -> np.ndarray:
    """Return the derivatives (..., 3, 3) of a value, over windows d (..., 2) px away, and of its gradient by the second
    derivatives uu, uv and vv: the mean over the window of the value, and its slope times the point's offset."""
    (x, y), (u, v), zero = np.moveaxis(d, -1, 0), np.moveaxis(offset, -1, 0), np.zeros(d.shape[:-1])
    value = [0.5 * x * x + 0.5 * window + x * u, x * y + x * v + y * u, 0.5 * y * y + 0.5 * window + y * v]
    return np.moveaxis(np.array([value, [x, y, zero], [zero, x, y]]), (0, 1), (-2, -1))


def solved(normal: np.ndarray, right: np.ndarray, valid: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    plane, spread = np.full(right.shape, np.nan), np.full(normal.shape, np.nan)
    scale = 1.0 / np.sqrt(np.einsum("nii->ni", normal[valid]))
    both = scale[:, :, None] * scale[:, None, :]
    inverse = np.linalg.inv(normal[valid] * both) * both
    plane[valid], spread[valid] = np.einsum("nij,nj->ni", inverse, right[valid]), inverse
    return plane, spread


def shifted(shape: tuple[int, ...], dv: int, du: int) -> tuple[tuple[slice, slice], tuple[slice, slice]]:
    """Return the nodes that have a neighbour at (dv, du), and those neighbours."""
    rows, columns = shape
    here = slice(max(0, -dv), rows - max(0, dv)), slice(max(0, -du), columns - max(0, du))
    return here, (slice(max(0, dv), rows - max(0, -dv)), slice(max(0, du), columns - max(0, -du)))
