"""Points from two views: optimal correction of the matches, then exact intersection of the rays.

Pixels of perspective views are corrected by Lindstrom's two iterations (`correct_lindstrom`, the default) or by
Hartley and Sturm's polynomial (`correct_hartley_sturm`); rays of any central camera, fields of view beyond 180
degrees included, by the angular optimum (`correct_rays`) or, with ray Jacobians, by the pixel optimum
(`correct_rays_px`). After the correction the two rays meet, so that the intersection is exact whatever formula finds
it. A point is valid if it lies at a positive range along both rays, which is cheirality for any field of view.

References: Hartley and Sturm, "Triangulation", 1997; Lindstrom, "Triangulation made easy", 2010; Oliensis, "Exact
two-image structure from motion", 2002 (the sum of squared sines has a closed form).
"""

from __future__ import annotations

import numpy as np

from rigkit.core.arrays import BoolArray, FloatArray, Mat3, Pixels, Points, RayJacobians, Rays
from rigkit.core.errors import InputError
from rigkit.geometry.projection_jacobian import projection_jacobian
from rigkit.geometry.rigid3 import Rigid3
from rigkit.geometry.rotation import cross, skew, unit
from rigkit.geometry.sampson import epipolar_normals

MIN_PARALLAX_RAD = 1e-9
"""Below this angle between the rays the range is rounding error."""


def correct_lindstrom(
    pixels1: Pixels,
    pixels2: Pixels,
    F21: Mat3,
    *,
    sigma1_px: FloatArray | float = 1.0,
    sigma2_px: FloatArray | float = 1.0,
) -> tuple[Pixels, Pixels]:
    """Return the nearest pixels (..., 2) that satisfy x2^T F21 x1 = 0: two iterations (`niter2`) of Lindstrom.

    The cost sum |dq_i|^2 / sigma_i^2 is within 2e-7 (relative, at 20 px) of the global optimum. Only the ratio of the
    sigmas matters. Works with epipoles at infinity and inside the images; a pair on both epipoles is left as it is.
    """
    q1, q2 = np.asarray(pixels1, dtype=np.float64), np.asarray(pixels2, dtype=np.float64)
    v1, v2 = (np.asarray(s, dtype=np.float64)[..., None] ** 2 for s in (sigma1_px, sigma2_px))
    et = F21[:2, :2]
    n = q1 @ F21[:2, :2].T + F21[:2, 2]
    m = q2 @ F21[:2, :2] + F21[2, :2]
    c = np.sum(q2 * n, axis=-1, keepdims=True) + (q1 @ F21[2, :2] + F21[2, 2])[..., None]
    a = v1 * v2 * np.sum((n @ et) * m, axis=-1, keepdims=True)
    b = 0.5 * (v2 * np.sum(n * n, axis=-1, keepdims=True) + v1 * np.sum(m * m, axis=-1, keepdims=True))
    # A negative radicand means that no correction of first-order direction reaches the curve: stop at the vertex.
    d = np.sqrt(np.maximum(b * b - a * c, 0.0))
    step = _ratio(c, b + d)
    n, m = n - v1 * step * (m @ et.T), m - v2 * step * (n @ et)
    norm = v2 * np.sum(n * n, axis=-1, keepdims=True) + v1 * np.sum(m * m, axis=-1, keepdims=True)
    step = step * _ratio(2.0 * d, norm)
    return q1 - v1 * step * m, q2 - v2 * step * n


def correct_hartley_sturm(pixels1: Pixels, pixels2: Pixels, F21: Mat3) -> tuple[Pixels, Pixels]:
    """Return the nearest pixels (N, 2) that satisfy x2^T F21 x1 = 0: the global optimum of Hartley and Sturm.

    Notes
    -----
    The stationary epipolar lines are the roots of a polynomial of degree six in t. Here t = scale * tan(w), which
    makes it a trigonometric polynomial in 2w: no leading coefficient can vanish and t at infinity is an ordinary
    point. The cost is evaluated at the angles of all six roots, real or not, and at infinity, because a nearly double
    real root may come out of rounding as a complex pair.
    """
    q1, q2 = np.asarray(pixels1, dtype=np.float64), np.asarray(pixels2, dtype=np.float64)
    u, _, vt = np.linalg.svd(F21)
    rotation1, f1, offset1 = _epipole_frame(vt[2], q1)
    rotation2, f2, offset2 = _epipole_frame(u[:, 2], q2)
    # Coordinates with the point at the origin and the epipole at (1, 0, f).
    local = rotation2 @ np.swapaxes(offset2, -1, -2) @ F21 @ offset1 @ np.swapaxes(rotation1, -1, -2)
    local = _ratio(local, np.linalg.norm(local, axis=(-2, -1), keepdims=True))
    a, b, c, d = (local[:, i, j, None] for i, j in ((1, 1), (1, 2), (2, 1), (2, 2)))
    f1, f2 = f1[:, None], f2[:, None]
    # First-order size of t: the distance from the line of the other image through the epipole.
    scale = np.abs(_ratio(d, np.sqrt(b * b + c * c + (f2 * d) ** 2))) + 1e-12

    def lines(t: FloatArray, s: FloatArray) -> tuple[FloatArray, FloatArray]:
        return a * t + b * s, c * t + d * s

    sample = np.arange(7) * (np.pi / 7.0)
    t, s = scale * np.sin(sample), np.cos(sample)[None]
    p, q = lines(t, s)
    g = t * s * (p**2 + (f2 * q) ** 2) ** 2 - (a * d - b * c) * (s**2 + (f1 * t) ** 2) ** 2 * p * q
    angle = _roots_on_circle(g)
    angle = np.concatenate([angle, np.full((len(q1), 1), 0.5 * np.pi)], axis=1)
    t, s = scale * np.sin(angle), np.cos(angle)
    p, q = lines(t, s)
    cost = _ratio(t**2, s**2 + (f1 * t) ** 2) + _ratio(q**2, p**2 + (f2 * q) ** 2)
    best = np.argmin(cost, axis=1)[:, None]
    t, s = np.take_along_axis(t, best, 1), np.take_along_axis(s, best, 1)
    p, q = lines(t, s)
    foot1 = _foot(np.concatenate([t * f1, s, -t], axis=1))
    foot2 = _foot(np.concatenate([-f2 * q, p, q], axis=1))
    out1 = (np.swapaxes(rotation1[:, :2, :2], -1, -2) @ foot1[..., None])[..., 0] + q1
    out2 = (np.swapaxes(rotation2[:, :2, :2], -1, -2) @ foot2[..., None])[..., 0] + q2
    # On an epipole every partner fits: nothing to correct.
    keep = ~np.isfinite(np.concatenate([out1, out2], axis=1)).all(axis=1, keepdims=True)
    return np.where(keep, q1, out1), np.where(keep, q2, out2)


CORRECTIONS = {"lindstrom": correct_lindstrom, "hartley_sturm": correct_hartley_sturm}


def correct_rays(
    rays1: Rays,
    rays2: Rays,
    cam2_from_cam1: Rigid3,
    *,
    sigma1_rad: FloatArray | float = 1.0,
    sigma2_rad: FloatArray | float = 1.0,
) -> tuple[Rays, Rays]:
    """Return the rays (..., 3) turned least, in sum of (sin angle / sigma)^2, so that they meet.

    Any field of view. Closed form: the epipolar plane's normal is the smaller eigenvector of a 2x2 matrix in the plane
    perpendicular to the baseline.
    """
    a, b = np.asarray(rays1) @ cam2_from_cam1.rotation.T, np.asarray(rays2, dtype=np.float64)
    # Without a baseline, any two directions: nothing is triangulated with those rays.
    basis = np.linalg.svd(cam2_from_cam1.translation_mm[None, :])[2][1:]
    wa = (a @ basis.T) / np.asarray(sigma1_rad)[..., None]
    wb = (b @ basis.T) / np.asarray(sigma2_rad)[..., None]
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
    """Return the rays that meet at the least pixel displacement, and the displacements dq1, dq2 (..., N, 2) px.

    Minimises |dq1|^2 / sigma1^2 + |dq2|^2 / sigma2^2 for any central camera. The first iteration is the Sampson
    correction; each further one linearises at the corrected rays f(dq) = unit(f + B dq).
    """
    v1, v2 = (np.asarray(s, dtype=np.float64)[..., None] ** 2 for s in (sigma1_px, sigma2_px))
    f1, f2 = np.asarray(rays1, dtype=np.float64), np.asarray(rays2, dtype=np.float64)
    dq1, dq2 = np.zeros((*f1.shape[:-1], 2)), np.zeros((*f2.shape[:-1], 2))
    for _ in range(iterations):
        # The unnormalised ray f + B dq has derivative B everywhere, and the constraint does not mind its length.
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

    Signed: a negative range means that the point would lie behind that camera, whatever the field of view. Undefined
    for parallel rays.
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

    With the ray Jacobians of both images the pixel displacement (in sigmas) is least, otherwise the angle.
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
    pixels1: Pixels, pixels2: Pixels, K1: Mat3, K2: Mat3, cam2_from_cam1: Rigid3, *, method: str = "lindstrom"
) -> tuple[Points, BoolArray]:
    """Return the points (N, 3) seen in two perspective views and where they are valid.

    `method` is "lindstrom" or "hartley_sturm"; `K1`, `K2` are the camera matrices. Raises InputError for another one.
    """
    if method not in CORRECTIONS:
        raise InputError(f"triangulation method '{method}' is unknown; known: {', '.join(CORRECTIONS)}")
    inverse1, inverse2 = np.linalg.inv(K1), np.linalg.inv(K2)
    F21 = inverse2.T @ skew(cam2_from_cam1.translation_mm) @ cam2_from_cam1.rotation @ inverse1
    near1, near2 = CORRECTIONS[method](pixels1, pixels2, F21)
    rays1 = unit(near1 @ inverse1[:, :2].T + inverse1[:, 2])
    rays2 = unit(near2 @ inverse2[:, :2].T + inverse2[:, 2])
    return triangulate_midpoint(rays1, rays2, cam2_from_cam1)


def point_covariances(
    points: Points,
    cam2_from_cam1: Rigid3,
    rays1: Rays,
    rays2: Rays,
    jacobians1: RayJacobians,
    jacobians2: RayJacobians,
    sigma1_px: FloatArray | float = 1.0,
    sigma2_px: FloatArray | float = 1.0,
    pose_covariance: FloatArray | None = None,
) -> FloatArray:
    """Return the covariance (N, 3, 3) mm^2 of triangulated points from the pixel sigmas, and from the pose if given.

    `pose_covariance` (6, 6) is that of (left rotation perturbation rad, translation mm). The pose's share is
    V^-1 W^T C W V^-1 of the bundle adjustment normal equations: it holds for points triangulated with the very pose
    that was estimated from these matches, because the residuals which fix the pose are orthogonal to those which fix
    the points.
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
    if pose_covariance is not None:
        rotated = in_cam2 - cam2_from_cam1.translation_mm
        d_pixels2_d_pose = d_pixels2_d_point_in_cam2 @ np.concatenate(
            [-skew(rotated), np.broadcast_to(np.eye(3), (*rotated.shape, 3))], axis=-1
        )
        gain = covariance @ (w2 * np.swapaxes(d_pixels2_d_point, -1, -2) @ d_pixels2_d_pose)
        covariance = covariance + gain @ pose_covariance @ np.swapaxes(gain, -1, -2)
    return np.where(bad, np.nan, covariance)


def _ratio(a: FloatArray, b: FloatArray) -> FloatArray:
    """Return a / b, zero where b is zero."""
    a, b = np.broadcast_arrays(a, b)
    return np.divide(a, b, out=np.zeros(a.shape), where=b != 0.0)


def _epipole_frame(epipole: FloatArray, pixels: Pixels) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return rotations (N, 3, 3) that bring the epipole to (1, 0, f) with each pixel at the origin, f, and shifts."""
    shift = np.broadcast_to(np.eye(3), (len(pixels), 3, 3)).copy()
    shift[:, :2, 2] = pixels
    moved = epipole[:2] - pixels * epipole[2]
    length = np.linalg.norm(moved, axis=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        direction = moved / length[:, None]
        f = epipole[2] / length
    bad = ~np.isfinite(direction).all(axis=1) | ~np.isfinite(f)
    direction[bad], f[bad] = [1.0, 0.0], np.nan
    rotation = np.zeros((len(pixels), 3, 3))
    rotation[:, 0, :2] = direction
    rotation[:, 1, 0], rotation[:, 1, 1] = -direction[:, 1], direction[:, 0]
    rotation[:, 2, 2] = 1.0
    return rotation, f, shift


def _roots_on_circle(samples: FloatArray) -> FloatArray:
    """Return the angles w (N, 6) of the roots z = exp(2iw) of trigonometric polynomials sampled at k pi / 7."""
    coefficients = np.fft.fft(np.nan_to_num(samples), axis=1) / 7.0
    # Frequencies -3 .. 3 of exp(2iw), highest first.
    poly = coefficients[:, [3, 2, 1, 0, 6, 5, 4]]
    size = np.abs(poly).max(axis=1, keepdims=True)
    lead = poly[:, :1]
    lead = np.where(np.abs(lead) > 1e-13 * size, lead, 1e-13 * size + (size == 0.0))
    companion = np.zeros((len(poly), 6, 6), dtype=complex)
    companion[:, np.arange(1, 6), np.arange(5)] = 1.0
    companion[:, 0, :] = -poly[:, 1:] / lead
    return np.asarray(0.5 * np.angle(np.linalg.eigvals(companion)))


def _foot(line: FloatArray) -> FloatArray:
    """Return the point (N, 2) of each line (N, 3) nearest to the origin."""
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(-line[:, :2] * line[:, 2:] / np.sum(line[:, :2] ** 2, axis=1, keepdims=True))
