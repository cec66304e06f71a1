"""Open3D, which only this module imports, inside its functions."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from rigkit.core.arrays import BoolArray, FloatArray, Mat3, Normals, Points, as_array
from rigkit.core.cloud import OrientedCloud
from rigkit.core.errors import DegenerateError


def to_open3d(cloud: OrientedCloud) -> Any:
    """Return an `open3d.geometry.PointCloud` with points (mm), normals and colours."""
    import open3d

    out = _point_cloud(cloud.points_mm)
    out.normals = open3d.utility.Vector3dVector(np.array(cloud.normals))
    out.colors = open3d.utility.Vector3dVector(cloud.colours / 255.0)
    return out


def mean_and_covariance(points: Points) -> tuple[FloatArray, Mat3]:
    """Return the mean (3,) and the covariance (3, 3), divided by N, of points (N, 3), by Open3D.

    Raises DegenerateError for no points.
    """
    array = as_array(points, (None, 3), "points")
    if len(array) == 0:
        raise DegenerateError("plane: no points to take the mean of")
    mean, covariance = _point_cloud(array).compute_mean_and_covariance()
    return np.asarray(mean, dtype=np.float64), np.asarray(covariance, dtype=np.float64)


def plane_inliers(points: Points, distance_mm: float, *, iterations: int = 1000) -> BoolArray:
    """Return the mask of the points (N, 3) within `distance_mm` of the dominant plane (RANSAC with a fixed seed).

    Raises DegenerateError for fewer than three points.
    """
    import open3d

    array = as_array(points, (None, 3), "points")
    if len(array) < 3:
        raise DegenerateError(f"plane: {len(array)} points do not fix one; at least 3 are needed")
    open3d.utility.random.seed(0)
    _, inliers = _point_cloud(array).segment_plane(distance_mm, 3, iterations)
    mask = np.zeros(len(array), dtype=bool)
    mask[np.asarray(inliers, dtype=np.int64)] = True
    return mask


def _point_cloud(points: Points) -> Any:
    import open3d

    # Open3D refuses read-only arrays.
    return open3d.geometry.PointCloud(open3d.utility.Vector3dVector(np.array(points, dtype=np.float64)))


MAX_MESH_MM = 1e30
"""Maximum coordinate: single precision ends at 3e38, and the surface extends beyond the points."""


class Mesh(NamedTuple):
    """A triangle mesh: points (V, 3) and normals (V, 3) of its vertices, colours (V, 3) uint8, triangles (T, 3)."""

    points: Points
    normals: Normals
    colours: NDArray[np.uint8]
    triangles: NDArray[np.int32]


def poisson_mesh(cloud: OrientedCloud, *, depth: int, cut: float) -> Mesh:
    """Return the screened Poisson surface of an oriented cloud (Kazhdan and Hoppe, TOG 2013).

    Raises DegenerateError: fewer than three points with a normal, points that coincide or overflow in single precision,
    or no surface left.

    Parameters
    ----------
    cloud : oriented cloud; normals point outwards.
    depth : depth of the octree: 2^depth cells along the longest side.
    cut : fraction of the vertices with the lowest point density to remove: Poisson closes every surface.
    """
    import open3d

    used = cloud.normals.any(axis=1)
    middle, half = _middle_and_half_extent(cloud.points_mm[used])
    # Open3D computes in single precision and crashes on an octree without extent: the cloud is scaled to a unit cube.
    within = _point_cloud((cloud.points_mm[used] - middle) / half)
    within.normals = open3d.utility.Vector3dVector(np.array(cloud.normals[used]))
    within.colors = open3d.utility.Vector3dVector(cloud.colours[used] / 255.0)
    mesh, density = open3d.geometry.TriangleMesh.create_from_point_cloud_poisson(within, depth=depth, n_threads=1)
    if cut > 0.0 and len(mesh.vertices):
        mesh.remove_vertices_by_mask(np.asarray(density) < np.quantile(np.asarray(density), cut))
    if not len(mesh.triangles):
        raise DegenerateError(f"mesh: no surface of {len(cloud)} points; lower the depth or the cut")
    mesh.compute_vertex_normals()
    return Mesh(
        np.asarray(mesh.vertices, dtype=np.float64) * half + middle,
        np.asarray(mesh.vertex_normals, dtype=np.float64),
        np.rint(255.0 * np.asarray(mesh.vertex_colors)).astype(np.uint8),
        np.asarray(mesh.triangles, dtype=np.int32),
    )


def _middle_and_half_extent(points: Points) -> tuple[FloatArray, float]:
    """Return the centre (3,) of the bounding box of points (N, 3), and half its longest side.

    Raises DegenerateError for fewer than three points, and for points that coincide in single precision.
    """
    if len(points) < 3:
        raise DegenerateError(f"mesh: {len(points)} points have a normal; at least 3 are needed")
    low, high = points.min(axis=0), points.max(axis=0)
    if max(-low.min(), high.max()) > MAX_MESH_MM:
        raise DegenerateError(
            f"mesh: points as far away as {max(-low.min(), high.max()):.3g} mm; at most {MAX_MESH_MM:.0e} mm are "
            "possible in the single precision of meshes; remove the points that are wrong"
        )
    if not (high.astype(np.float32) > low.astype(np.float32)).any():
        raise DegenerateError(
            f"mesh: the {len(points)} points are all in one place in the single precision of meshes; move the cloud "
            "to the origin, or use one with an extent"
        )
    return (low + high) / 2.0, float((high - low).max()) / 2.0
