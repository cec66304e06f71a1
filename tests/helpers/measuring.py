"""Quantities measured from points by their definition, the reference for certificates."""

from __future__ import annotations

import numpy as np

from rigkit.core.arrays import FloatArray
from rigkit.core.measurement_task import Quantity


def read_off(quantity: Quantity, points: FloatArray) -> FloatArray:
    """The quantity measured from points (N, K, 3) by its definition, (N, ways)."""
    if quantity is Quantity.ANGLE:
        a = points[:, 1:] - points[:, :1]
        a /= np.linalg.norm(a, axis=-1, keepdims=True)
        # Edges go round the vertex in equal steps: a quarter of them on is the other edge.
        cosine = np.sum(a * np.roll(a, -(a.shape[1] // 4), axis=1), axis=-1)
        return np.asarray(np.rad2deg(np.arccos(cosine)))
    if quantity is Quantity.PLANE:
        centred = points - points.mean(axis=1, keepdims=True)
        normals = np.linalg.svd(centred)[2][:, 2]
        normals *= np.sign(np.sum(normals * points.mean(axis=1), axis=1))[:, None]
        return np.asarray(np.einsum("nkx,nx->nk", centred, normals))
    ends = points.reshape(len(points), -1, 2, 3)
    return np.linalg.norm(ends[:, :, 1] - ends[:, :, 0], axis=-1)
