"""Open3D: the only module that imports it, and only when a function is called."""

from __future__ import annotations

from typing import Any

import numpy as np

from rigkit.core.arrays import BoolArray, FloatArray, Mat3, Normals, Points, as_array
from rigkit.core.cloud import OrientedCloud
from rigkit.core.errors import DegenerateError

__all__ = ["from_open3d", "mean_and_covariance", "plane_inliers", "to_open3d"]


def to_open3d(cloud: OrientedCloud) -> Any:
    """Return an `open3d.geometry.PointCloud` with points (mm), normals and colours."""
    import open3d

    out = _point_cloud(cloud.points_mm)
    out.normals = open3d.utility.Vector3dVector(np.array(cloud.normals))
    out.colors = open3d.utility.Vector3dVector(cloud.colours / 255.0)
    return out


def from_open3d(point_cloud: Any) -> tuple[Points, Normals]:
    """Return points and normals (N, 3) of an `open3d.geometry.PointCloud`; normals are NaN where it has none."""
    points = np.array(point_cloud.points, dtype=np.float64).reshape(-1, 3)
    normals = np.array(point_cloud.normals, dtype=np.float64).reshape(-1, 3)
    return points, normals if len(normals) == len(points) else np.full_like(points, np.nan)


def mean_and_covariance(points: Points) -> tuple[FloatArray, Mat3]:
    """Return the mean (3,) and the covariance (3, 3), divided by N, of points (N, 3), by Open3D.

    Raises DegenerateError for no points.
    """
    array = as_array(points, (None, 3), "points")
    if len(array) == 0:
        raise DegenerateError("plane: no points to take the mean of")
    mean, covariance = _point_cloud(array).compute_mean_and_covariance()
    return np.asarray(mean, dtype=np.float64), np.asarray(covariance, dtype=np.float64)


def plane_inliers(points: Points, distance_mm: float, *, iterations: int = 1000, seed: int = 0) -> BoolArray:
    """Return the mask of the points (N, 3) within `distance_mm` of the plane that most of them share (RANSAC).

    Deterministic for one seed. Raises DegenerateError for fewer than three points.
    """
    import open3d

    array = as_array(points, (None, 3), "points")
    if len(array) < 3:
        raise DegenerateError(f"plane: {len(array)} points do not fix one; at least 3 are needed")
    open3d.utility.random.seed(seed)
    _, inliers = _point_cloud(array).segment_plane(distance_mm, 3, iterations)
    mask = np.zeros(len(array), dtype=bool)
    mask[np.asarray(inliers, dtype=np.int64)] = True
    return mask


def _point_cloud(points: Points) -> Any:
    import open3d

    # Open3D takes a view of the memory and refuses one that is read-only.
    return open3d.geometry.PointCloud(open3d.utility.Vector3dVector(np.array(points, dtype=np.float64)))
