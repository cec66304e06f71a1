"""What kernels/planes.c computes, in numpy: all nodes at once, a neighbour after the other."""

from __future__ import annotations

import numpy as np


def fitted_planes(
    values: np.ndarray, information: np.ndarray, frames: np.ndarray, *, reach: int, rounds: int, turn: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return planes (R, C, 3), normal matrices (R, C, 3, 3), sums of weights and of weighted squares (R, C)."""
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
        plane, spread = solved(normal, right, valid)
    squares -= np.sum(right * plane, axis=-1)
    return (
        plane,
        np.where(valid[..., None, None], normal, np.nan),
        np.where(valid, support, np.nan),
        np.where(valid, squares, np.nan),
    )


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
