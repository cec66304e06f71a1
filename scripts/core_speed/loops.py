"""Plain numpy solutions of single problems, as written in the paper, to compare the speed with."""

from __future__ import annotations

import numpy as np


def loop_affine(method: str, d1: np.ndarray, d2: np.ndarray, n1: np.ndarray, n2: np.ndarray) -> np.ndarray:
    """One corner as one would write it from the paper, with numpy's dense solvers."""
    if method in ("2SDIR", "3SDIR"):
        k = 2 if method == "2SDIR" else len(d1)
        return np.linalg.lstsq(d1[:k], d2[:k], rcond=None)[0].T
    rows = np.array(
        [np.outer([-b[1], b[0]], a).ravel() / np.hypot(*a) / np.hypot(*b) for a, b in zip(d1, d2, strict=True)]
    )
    if method == "DET3UDIR":
        B = np.fliplr(np.diag([1.0, -1.0, -1.0, 1.0]))
        values, vectors = np.linalg.eig(B @ (rows.T @ rows))
        shapes = np.real(vectors).T.reshape(-1, 2, 2)
        determinants = np.linalg.det(shapes)
        best = min((v, i) for i, v in enumerate(np.real(values)) if determinants[i] > 0.0)[1]
        area = np.linalg.det(d2[:2]) / np.linalg.det(d1[:2])
        # Noise can reverse the order of two directions; then there is no scale, here as in rigkit.
        A = shapes[best] * np.sqrt(area / determinants[best] if area > 0.0 else np.nan)
        return A * np.sign(np.sum(d2 * (d1 @ A.T)))
    k = 2 if method == "F2UDIR" else len(d1)
    A0 = -np.outer(n2, n1) / (n2 @ n2)
    m = np.array([-n2[1], n2[0]]) / np.hypot(*n2)
    free = np.stack([np.outer(m, [1.0, 0.0]).ravel(), np.outer(m, [0.0, 1.0]).ravel()], axis=1)
    y = np.linalg.lstsq(rows[:k] @ free, -rows[:k] @ A0.ravel(), rcond=None)[0]
    return A0 + np.outer(m, y)


def loop_normal(J1: np.ndarray, J2: np.ndarray, A: np.ndarray) -> np.ndarray:
    """One normal with numpy's dense solvers."""
    d = np.cross(J1[0], J1[1])
    d /= np.linalg.norm(d)
    h = J2 @ d
    y = (J2 @ np.linalg.pinv(J1) - A).T @ h / (h @ h)
    n = -(J1.T @ y + d)
    return n / np.linalg.norm(n)


def loop_planar(gram: np.ndarray) -> np.ndarray:
    """One planar problem: the concave dual by golden section, then both pairs of entries scaled to length one."""
    J = np.diag([1.0, -1.0, -1.0, 1.0])
    low, high = -2.0 * np.trace(gram), 2.0 * np.trace(gram)
    golden = (np.sqrt(5.0) - 1.0) / 2.0
    for _ in range(60):
        a, b = high - golden * (high - low), low + golden * (high - low)
        if np.linalg.eigvalsh(gram + a * J)[0] < np.linalg.eigvalsh(gram + b * J)[0]:
            low = a
        else:
            high = b
    e = np.linalg.eigh(gram + 0.5 * (low + high) * J)[1][:, 0]
    return e / np.sqrt([e[0] ** 2 + e[3] ** 2, e[1] ** 2 + e[2] ** 2, e[1] ** 2 + e[2] ** 2, e[0] ** 2 + e[3] ** 2])
