"""The circle model of circles.c, by numerical inversion of its map and without the kernel's series for the distance."""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree
from scipy.special import ndtr

from rigkit.core.arrays import FloatArray


def picture(
    size_px: tuple[int, int],
    centre: FloatArray,
    matrix: FloatArray,
    bend: FloatArray,
    blur_px: float,
    outside: float,
    contrast: float,
    slope: FloatArray,
    uneven_px2: tuple[float, float] = (0.0, 0.0),
) -> FloatArray:
    """Return the brightness (height, width) of a circle whose edge is centre + M w + H(w, w) / 2 over |w| = 1.

    The distance from the edge is that to the nearest of many points on it; `slope` : of the light, per px.
    `uneven_px2` : what the blur's variance has more, times cosine and sine of twice the angle of the edge's normal.
    """
    angle = np.linspace(0.0, 2.0 * np.pi, 4001)[:-1]
    w = np.stack([np.cos(angle), np.sin(angle)])
    squares = np.stack([w[0] ** 2, 2.0 * w[0] * w[1], w[1] ** 2])
    edge = (centre[:, None] + matrix @ w + 0.5 * bend @ squares).T
    u, v = np.meshgrid(np.arange(size_px[0]), np.arange(size_px[1]))
    pixels = np.stack([u.ravel(), v.ravel()], axis=-1).astype(np.float64)
    at = cKDTree(edge).query(pixels)[1]
    before, after = edge[at - 1], edge[(at + 1) % len(edge)]
    tangent = after - before
    normal = np.stack([tangent[:, 1], -tangent[:, 0]], axis=-1) / np.linalg.norm(tangent, axis=1, keepdims=True)
    normal *= np.sign(np.linalg.det(matrix))
    distance = ((pixels - edge[at]) * normal).sum(axis=1)
    first, second = 0.5 * tangent, after - 2.0 * edge[at] + before
    turn = first[:, 0] * second[:, 1] - first[:, 1] * second[:, 0]
    curvature = np.abs(turn) / np.linalg.norm(first, axis=1) ** 3
    blur = np.sqrt(
        blur_px**2 + uneven_px2[0] * (normal[:, 0] ** 2 - normal[:, 1] ** 2) + uneven_px2[1] * 2.0 * normal.prod(axis=1)
    )
    share = ndtr(-distance / blur - 0.5 * curvature * blur)
    light = 1.0 + (pixels - centre) @ slope
    return np.asarray((light * (outside + contrast * share)).reshape(size_px[1], size_px[0]))
