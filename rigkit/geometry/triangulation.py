"""Triangulation from two views: optimal correction of the matches, then exact intersection of the rays.

Pixels of perspective views are corrected by Lindstrom's two iterations (`correct_lindstrom`); rays of any central
camera, also beyond 180 degrees, by the angular optimum (`correct_rays`) or, with ray Jacobians, by the pixel optimum
(`correct_rays_px`). After the correction the two rays intersect. A point is valid if its range is positive along both
rays, which is cheirality for any field of view.

References: Lindstrom, "Triangulation made easy", 2010; Oliensis, "Exact two-image structure from motion", 2002 (the sum
of squared sines has a closed form).
"""

from __future__ import annotations

import numpy as np

from rigkit.core.arrays import BoolArray, FloatArray, Mat3, Pixels, Points, RayJacobians, Rays
from rigkit.geometry.projection_jacobian import projection_jacobian
from rigkit.geometry.rigid3 import Rigid3
from rigkit.geometry.rotation import cross, skew, unit
from rigkit.geometry.sampson import epipolar_normals

MIN_PARALLAX_RAD = 1e-9
"""Below this angle between the rays the range is rounding error."""


def correct_lindstrom(pixels1: Pixels, pixels2: Pixels, F21: Mat3) -> tuple[Pixels, Pixels]:
    """Return the nearest pixels (..., 2) that satisfy x2^T F21 x1 = 0: two iterations (`niter2`) of Lindstrom.

    The sum of the squared moves is within 2e-7 (relative, at 20 px) of the global optimum. Works with epipoles at
    infinity and inside the images; a pair on both epipoles is left as it is.
    """
    q1, q2 = np.asarray(pixels1, dtype=np.float64), np.asarray(pixels2, dtype=np.float64)
    et = F21[:2, :2]
    n = q1 @ F21[:2, :2].T + F21[:2, 2]
    m = q2 @ F21[:2, :2] + F21[2, :2]
    c = np.sum(q2 * n, axis=-1, keepdims=True) + (q1 @ F21[2, :2] + F21[2, 2])[..., None]
    a = np.sum((n @ et) * m, axis=-1, keepdims=True)
    b = 0.5 * (np.sum(n * n, axis=-1, keepdims=True) + np.sum(m * m, axis=-1, keepdims=True))
    # A negative radicand means that no correction of first-order direction reaches the curve: stop at the vertex.
    d = np.sqrt(np.maximum(b * b - a * c, 0.0))
    step = _ratio(c, b + d)
    n, m = n - step * (m @ et.T), m - step * (n @ et)
    norm = np.sum(n * n, axis=-1, keepdims=True) + np.sum(m * m, axis=-1, keepdims=True)
    step = step * _ratio(2.0 * d, norm)
    return q1 - step * m, q2 - step * n


def correct_rays(rays1: Rays, rays2: Rays, cam2_from_cam1: Rigid3) -> tuple[Rays, Rays]:
    """Return the rays (..., 3) turned least, in the sum of the squared sines, so that they meet.

    Any field of view. Closed form: the epipolar plane's normal is the smaller eigenvector of a 2x2 matrix in the plane
    perpendicular to the baseline.
    """
    a, b = np.asarray(rays1) @ cam2_from_cam1.rotation.T, np.asarray(rays2, dtype=np.float64)
    # Without a baseline any two directions will do: such rays are not triangulated.
    basis = np.linalg.svd(cam2_from_cam1.translation_mm[None, :])[2][1:]
    wa, wb = a @ basis.T, b @ basis.T
    moment = wa[..., :, None] * wa[..., None, :] + wb[..., :, None] * wb[..., None, :]
    normal = np.linalg.eigh(moment)[1][..., 0] @ basis
    a = unit(a - normal * np.sum(a * normal, axis=-1, keepdims=True))
    b = unit(b - normal * np.sum(b * normal, axis=-1, keepdims=True))
    return np.asarray(a @ cam2_from_cam1.rotation), b


def correct_rays_px(
    rays1: Rays,
    rays2: Rays,
    E21: Mat3,
    jacobians1: RayJacobians,
    jacobians2: RayJacobians,
    *,
    sigma1_px: FloatArray | float = 1.0,
    sigma2_px: FloatArray | float = 1.0,
    iterations: int = 2,
) -> tuple[Rays, Rays, FloatArray, FloatArray]:
    """Return the rays that intersect with the least pixel displacement, and the displacements dq1, dq2 (..., N, 2) px.

    Minimises |dq1|^2 / sigma1^2 + |dq2|^2 / sigma2^2 for any central camera. The first iteration is the Sampson
    correction; each further one linearises at the corrected rays f(dq) = unit(f + B dq).
    """
    v1, v2 = (np.asarray(s, dtype=np.float64)[..., None] ** 2 for s in (sigma1_px, sigma2_px))
    f1, f2 = np.asarray(rays1, dtype=np.float64), np.asarray(rays2, dtype=np.float64)
    dq1, dq2 = np.zeros((*f1.shape[:-1], 2)), np.zeros((*f2.shape[:-1], 2))
    for _ in range(iterations):
        # The unnormalised ray f + B dq has derivative B everywhere, and the constraint is independent of its length.
        c, n1, n2 = epipolar_normals(E21, f1, f2, jacobians1, jacobians2)
        at_measured = c - np.sum(n1 * dq1, axis=-1) - np.sum(n2 * dq2, axis=-1)
        variance = np.sum(v1 * n1 * n1 + v2 * n2 * n2, axis=-1)
        step = _ratio(at_measured, variance)[..., None]
        dq1, dq2 = -v1 * step * n1, -v2 * step * n2
        f1 = rays1 + (jacobians1 @ dq1[..., None])[..., 0]
        f2 = rays2 + (jacobians2 @ dq2[..., None])[..., 0]
    return unit(f1), unit(f2), dq1, dq2


def ray_ranges(rays1: Rays, rays2: Rays, cam2_from_cam1: Rigid3) -> tuple[FloatArray, FloatArray, BoolArray]:
    """Return the ranges (...) along both rays at which they come closest, mm, and where they are defined.

    Signed: with a negative range the point is behind that camera. Undefined for parallel rays.
    """
    a, b = np.asarray(rays1) @ cam2_from_cam1.rotation.T, np.asarray(rays2, dtype=np.float64)
    t = cam2_from_cam1.translation_mm
    axis = cross(b, a)
    square = np.sum(axis * axis, axis=-1)
    defined = square > MIN_PARALLAX_RAD**2
    safe = np.where(defined, square, np.nan)
    range1 = np.sum(cross(t, b) * axis, axis=-1) / safe
    range2 = np.sum(cross(t, a) * axis, axis=-1) / safe
    return range1, range2, defined


def triangulate_midpoint(rays1: Rays, rays2: Rays, cam2_from_cam1: Rigid3) -> tuple[Points, BoolArray]:
    """Return the midpoints (..., 3) of the rays' closest points in the frame of camera 1, and where ranges are > 0."""
    range1, range2, defined = ray_ranges(rays1, rays2, cam2_from_cam1)
    on1 = np.asarray(rays1) * range1[..., None]
    on2 = (np.asarray(rays2) * range2[..., None] - cam2_from_cam1.translation_mm) @ cam2_from_cam1.rotation
    valid = defined & (np.nan_to_num(range1) > 0.0) & (np.nan_to_num(range2) > 0.0)
    return 0.5 * (on1 + on2), valid


def triangulate_rays(
    rays1: Rays,
    rays2: Rays,
    cam2_from_cam1: Rigid3,
    *,
    jacobians1: RayJacobians | None = None,
    jacobians2: RayJacobians | None = None,
    sigma1_px: FloatArray | float = 1.0,
    sigma2_px: FloatArray | float = 1.0,
) -> tuple[Points, BoolArray]:
    """Return the points (N, 3) in the frame of camera 1 and where they are valid (positive range along both rays).

    With the ray Jacobians of both images it minimises the pixel displacements (in sigmas), otherwise the angles.
    """
    if jacobians1 is None or jacobians2 is None:
        near1, near2 = correct_rays(rays1, rays2, cam2_from_cam1)
    else:
        E21 = skew(cam2_from_cam1.translation_mm) @ cam2_from_cam1.rotation
        near1, near2, _, _ = correct_rays_px(
            rays1, rays2, E21, jacobians1, jacobians2, sigma1_px=sigma1_px, sigma2_px=sigma2_px, iterations=3
        )
    return triangulate_midpoint(near1, near2, cam2_from_cam1)


def triangulate_pixels(
    pixels1: Pixels, pixels2: Pixels, K1: Mat3, K2: Mat3, cam2_from_cam1: Rigid3
) -> tuple[Points, BoolArray]:
    """Return the points (N, 3) seen in two perspective views with camera matrices `K1`, `K2`, and where they are
    valid."""
    inverse1, inverse2 = np.linalg.inv(K1), np.linalg.inv(K2)
    F21 = inverse2.T @ skew(cam2_from_cam1.translation_mm) @ cam2_from_cam1.rotation @ inverse1
    near1, near2 = correct_lindstrom(pixels1, pixels2, F21)
    rays1 = unit(near1 @ inverse1[:, :2].T + inverse1[:, 2])
    rays2 = unit(near2 @ inverse2[:, :2].T + inverse2[:, 2])
    return triangulate_midpoint(rays1, rays2, cam2_from_cam1)


def point_uncertainty(
    points: Points,
    cam2_from_cam1: Rigid3,
    rays1: Rays,
    rays2: Rays,
    jacobians1: RayJacobians,
    jacobians2: RayJacobians,
    sigma1_px: FloatArray | float = 1.0,
    sigma2_px: FloatArray | float = 1.0,
) -> tuple[FloatArray, FloatArray]:
    """Return the covariance (N, 3, 3) of triangulated points from the pixel sigmas, in their unit squared, and their
    derivatives (N, 3, 6) by the pose (left rotation perturbation rad, translation).

    With V the block of the point and W the coupling block of the bundle adjustment's normal equations these are V^-1
    and -V^-1 W^T. The covariance of a pose estimated from the same matches is added through the derivatives, because
    pose and points are determined by orthogonal residuals. NaN where a point has no triangulation.
    """
    in_cam2 = cam2_from_cam1.apply(points)
    d_pixels1_d_point = projection_jacobian(rays1, jacobians1, np.linalg.norm(points, axis=-1))
    d_pixels2_d_point_in_cam2 = projection_jacobian(rays2, jacobians2, np.linalg.norm(in_cam2, axis=-1))
    d_pixels2_d_point = d_pixels2_d_point_in_cam2 @ cam2_from_cam1.rotation
    w1, w2 = (np.asarray(s, dtype=np.float64)[..., None, None] ** -2.0 for s in (sigma1_px, sigma2_px))
    information = (
        w1 * np.swapaxes(d_pixels1_d_point, -1, -2) @ d_pixels1_d_point
        + w2 * np.swapaxes(d_pixels2_d_point, -1, -2) @ d_pixels2_d_point
    )
    bad = ~np.isfinite(information).all(axis=(-2, -1), keepdims=True)
    covariance = np.linalg.inv(np.where(bad, np.eye(3), information))
    rotated = in_cam2 - cam2_from_cam1.translation_mm
    d_pixels2_d_pose = d_pixels2_d_point_in_cam2 @ np.concatenate(
        [-skew(rotated), np.broadcast_to(np.eye(3), (*rotated.shape, 3))], axis=-1
    )
    by_pose = -covariance @ (w2 * np.swapaxes(d_pixels2_d_point, -1, -2) @ d_pixels2_d_pose)
    return np.where(bad, np.nan, covariance), np.where(bad, np.nan, by_pose)


def _ratio(a: FloatArray, b: FloatArray) -> FloatArray:
    """Return a / b, zero where b is zero."""
    a, b = np.broadcast_arrays(a, b)
    return np.divide(a, b, out=np.zeros(a.shape), where=b != 0.0)
