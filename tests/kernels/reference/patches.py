"""What kernels/patches.c computes, in numpy: one patch at a time, and growth over nodes with a heap."""

from __future__ import annotations

import heapq
from typing import Any

import numpy as np

STEPS, SETTLED = 20, 1e-3


def cubic_at(image: np.ndarray, u: np.ndarray, v: np.ndarray) -> np.ndarray:
    """Cubic convolution with a = -1/2."""
    left, top = np.floor(u).astype(int), np.floor(v).astype(int)

    def weights(t: np.ndarray) -> list[np.ndarray]:
        return [
            -0.5 * t + t**2 - 0.5 * t**3,
            1.0 - 2.5 * t**2 + 1.5 * t**3,
            0.5 * t + 2.0 * t**2 - 1.5 * t**3,
            -0.5 * t**2 + 0.5 * t**3,
        ]

    across, down = weights(u - left), weights(v - top)
    return sum(down[j] * across[i] * image[top - 1 + j, left - 1 + i] for j in range(4) for i in range(4))


def aligned(
    image1: np.ndarray,
    image2: np.ndarray,
    q1: np.ndarray,
    q2: np.ndarray,
    A: np.ndarray,
    *,
    half: int,
    width: float,
    prior: Any = None,
    excess_noise: float = 1.0,
    min_noise: float = 0.3,
) -> tuple[np.ndarray, np.ndarray, float, np.ndarray]:
    """Return place, affinity, correlation and covariance (6, 6) of (u2, v2, A).

    `prior(q2, A)` returns rows (3, 6) on (dA, dq) and values (3,), each over its sigma.
    """
    line = np.arange(-half, half + 1.0)
    u, v = (x.ravel() for x in np.meshgrid(line, line))
    w = np.exp(-0.5 * (u * u + v * v) / width**2)
    T = cubic_at(image1, q1[0] + u, q1[1] + v)
    gu = 0.5 * (cubic_at(image1, q1[0] + u + 1, q1[1] + v) - cubic_at(image1, q1[0] + u - 1, q1[1] + v))
    gv = 0.5 * (cubic_at(image1, q1[0] + u, q1[1] + v + 1) - cubic_at(image1, q1[0] + u, q1[1] + v - 1))
    J = np.stack([gu * u, gu * v, gv * u, gv * v, gu, gv], axis=1)
    # Free of gain and offset: orthogonal to the patch and to a constant.
    basis = np.stack([np.ones_like(T), T], axis=1)
    J = J - basis @ np.linalg.solve(basis.T @ (w[:, None] * basis), basis.T @ (w[:, None] * J))
    H = J.T @ (w[:, None] * J)
    T = T - (w @ T) / w.sum()
    effective = w.sum() ** 2 / (w @ w)
    A, q2 = A.copy(), q2.copy()
    for _ in range(STEPS + 1):
        there = cubic_at(image2, q2[0] + A[0, 0] * u + A[0, 1] * v, q2[1] + A[1, 0] * u + A[1, 1] * v)
        there = there - (w @ there) / w.sum()
        energy, common = w @ (T * T), w @ (T * there)
        correlation = common / np.sqrt(energy * (w @ (there * there)))
        noise = energy * (1 - correlation**2) / w.sum() * effective / (effective - 8.0) + min_noise**2
        step, normal = energy / common * J.T @ (w * there), H.copy()
        if prior is not None:
            rows, values = prior(q2, A)
            step += excess_noise * noise * rows.T @ values
            normal += excess_noise * noise * rows.T @ rows
        step = np.linalg.solve(normal, step)
        A = A @ np.linalg.inv(np.eye(2) + step[:4].reshape(2, 2))
        q2 = q2 - A @ step[4:]
        if half * np.abs(step[:4]).sum() + np.abs(step[4:]).sum() < SETTLED:
            break
    by = np.zeros((6, 6))
    by[:2, 4:] = -A
    by[2:, :4] = -np.kron(A, np.eye(2))
    return q2, A, float(correlation), excess_noise * noise * by @ np.linalg.inv(normal) @ by.T


def grown(
    image1: np.ndarray,
    image2: np.ndarray,
    seeds: np.ndarray,
    step: int,
    *,
    half: int,
    width: float,
    min_correlation: float,
    max_move: float,
    max_tries: int,
) -> dict[tuple[int, int], tuple[np.ndarray, np.ndarray, float]]:
    """Return (row, column) -> place, affinity and correlation of what grows without an epipolar geometry."""
    rows, columns = (image1.shape[0] - 1) // step + 1, (image1.shape[1] - 1) // step + 1
    out: dict[tuple[int, int], tuple[np.ndarray, np.ndarray, float]] = {}
    tries: dict[tuple[int, int], int] = {}
    heap: list[tuple[float, tuple[int, int]]] = []

    def attempt(node: tuple[int, int], q2: np.ndarray, A: np.ndarray) -> None:
        q1 = step * np.array([node[1], node[0]], float)
        for q, turn, image in ((q1, np.eye(2), image1), (q2, A, image2)):
            reach = (half + 1.0) * np.abs(turn).sum(axis=1)
            if (q - reach < 2.0).any() or (q + reach > np.array(image.shape[::-1]) - 4.0).any():
                return
        place, affinity, correlation, _ = aligned(image1, image2, q1, q2, A, half=half, width=width)
        if correlation >= min_correlation and np.linalg.norm(place - q2) < max_move:
            out[node] = place, affinity, correlation
            heapq.heappush(heap, (-correlation, node))

    for seed in seeds:
        column, row = np.floor(seed[:2] / step + 0.5).astype(int)
        A = seed[4:].reshape(2, 2)
        if (row, column) not in out:
            attempt((row, column), seed[2:4] + A @ (step * np.array([column, row]) - seed[:2]), A)
    while heap:
        _, (row, column) = heapq.heappop(heap)
        q2, A, _ = out[row, column]
        for dv, du in ((0, 1), (0, -1), (1, 0), (-1, 0)):
            node = row + dv, column + du
            if not (0 <= node[0] < rows and 0 <= node[1] < columns) or node in out:
                continue
            if tries.get(node, 0) < max_tries:
                tries[node] = tries.get(node, 0) + 1
                attempt(node, q2 + A @ (step * np.array([du, dv], float)), A)
    return out
