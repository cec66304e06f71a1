"""d pixel / d point of any central camera, from its ray, ray Jacobian and range."""

from __future__ import annotations

import numpy as np

from rigkit.core.arrays import FloatArray, Points, RayJacobians, Rays
from rigkit.geometry.rigid3 import Rigid3


def projection_jacobian(rays: Rays, ray_jacobians: RayJacobians, ranges_mm: FloatArray) -> FloatArray:
    """Return d pixel / d point (..., 2, 3) in px/mm, in the camera's frame.

    Parameters
    ----------
    rays : (..., 3) unit rays f.
    ray_jacobians : (..., 3, 2) B = d ray / d pixel.
    ranges_mm : (...) distance r of the point from the camera's centre.

    Notes
    -----
    X = r f(q) gives dX = r B dq + f dr, so J is the first two rows of inv([r B | f]): no projection function needed.
    NaN where the ray Jacobian is singular or the range is zero.
    """
    f = np.asarray(rays, dtype=np.float64)
    b = np.asarray(ray_jacobians, dtype=np.float64)
    fx, fy, fz = f[..., 0], f[..., 1], f[..., 2]
    ax, ay, az = b[..., 0, 0], b[..., 1, 0], b[..., 2, 0]
    bx, by, bz = b[..., 0, 1], b[..., 1, 1], b[..., 2, 1]
    out = np.empty((*np.broadcast_shapes(b.shape[:-2], np.shape(ranges_mm)), 2, 3))
    # Rows of the inverse of [a b f] by cross products: (b x f) / det and (f x a) / det.
    ux, uy, uz = by * fz - bz * fy, bz * fx - bx * fz, bx * fy - by * fx
    scale = np.asarray(ranges_mm, dtype=np.float64) * (ax * ux + ay * uy + az * uz)
    with np.errstate(divide="ignore", invalid="ignore"):
        scale = np.where(scale == 0.0, np.nan, 1.0 / scale)
    out[..., 0, 0], out[..., 0, 1], out[..., 0, 2] = ux * scale, uy * scale, uz * scale
    out[..., 1, 0] = (fy * az - fz * ay) * scale
    out[..., 1, 1] = (fz * ax - fx * az) * scale
    out[..., 1, 2] = (fx * ay - fy * ax) * scale
    return out


def pair_projection_jacobians(
    points_mm: Points,
    rays1: Rays,
    ray_jacobians1: RayJacobians,
    rays2: Rays,
    ray_jacobians2: RayJacobians,
    cam2_from_cam1: Rigid3,
) -> tuple[FloatArray, FloatArray]:
    """Return d pixel / d point (..., 2, 3) of both images, both with respect to the point in the frame of camera 1.

    Parameters
    ----------
    points_mm : (..., 3) in the frame of camera 1.
    rays1, rays2 : (..., 3) unit rays, each in its own camera's frame.
    ray_jacobians1, ray_jacobians2 : (..., 3, 2)
    cam2_from_cam1 : relative pose in the unit of the points.
    """
    points = np.asarray(points_mm, dtype=np.float64)
    jacobian1 = projection_jacobian(rays1, ray_jacobians1, np.linalg.norm(points, axis=-1))
    range2 = np.linalg.norm(cam2_from_cam1.apply(points), axis=-1)
    jacobian2 = projection_jacobian(rays2, ray_jacobians2, range2) @ cam2_from_cam1.rotation
    return jacobian1, np.asarray(jacobian2)
