"""Point clouds with a depth edge: a square in front of a wall, seen from the origin."""

from __future__ import annotations

import numpy as np

from rigkit.core.cloud import OrientedCloud

NEAR_MM, FAR_MM, HALF = 1000.0, 4000.0, 0.2
"""Distances of the square and the wall, and the square's half side over its distance."""


def cloud_of(points: np.ndarray, normals: np.ndarray) -> OrientedCloud:
    n = len(points)
    return OrientedCloud(
        points_mm=points,
        normals=normals,
        colours=np.full((n, 3), 90, dtype=np.uint8),
        board_index=np.full(n, -1),
        grid=np.zeros((n, 2), dtype=np.int64),
        sigma_mm=np.ones(n),
        normal_sigma_rad=np.full(n, 0.01),
        board_ids=(),
    )


def square_before_wall(count: int = 61) -> OrientedCloud:
    at = np.linspace(-0.6, 0.6, count)
    x, y = (v.ravel() for v in np.meshgrid(at, at))
    depth = np.where((np.abs(x) < HALF) & (np.abs(y) < HALF), NEAR_MM, FAR_MM)
    points = depth[:, None] * np.stack([x, y, np.ones_like(x)], axis=1)
    return cloud_of(points, np.broadcast_to([0.0, 0.0, -1.0], points.shape))
