"""Surface normals from affinities, with their predicted error, and affinities from normals.

Errors of the corners and of the pose (`geometry_covariance`) are usually small beside those of the affinities. Near an
epipole, or with very accurate directions, they limit parallax, range and normal.

Source: L. Hajder, "Affine Correspondences in Stereo Vision: Theory, Practice, and Limitations", and D. Barath, J.
Molnar, L. Hajder, "Optimal Surface Normal from Affine Transformation" (VISAPP 2015), the paper's optimal normal.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from rigkit.affine.affinities import EpipolarNormals
from rigkit.affine.components import blocks, finite
from rigkit.core.arrays import Affines, BoolArray, FloatArray, Normals, RayJacobians, Rays, as_floats
from rigkit.core.errors import InputError
from rigkit.core.matches import Matches
from rigkit.geometry.projection_jacobian import pair_projection_jacobians
from rigkit.geometry.rigid3 import Rigid3
from rigkit.geometry.rotation import angle_between, exp_so3, skew, unit
from rigkit.geometry.triangulation import triangulate_midpoint

MIN_PARALLAX = 1e-9
"""Smallest |h| / |J2| (about the angle between the two viewing rays, rad) that is not rounding."""
STEP_PX = 1e-3
STEP_RAD = 1e-7
BASELINE_STEP = 1e-6
"""Steps of the central differences, with negligible rounding and second-order errors."""


@dataclass(frozen=True, eq=False, slots=True)
class NormalEstimate:
    """Normals of N points with their predicted error.

    Attributes
    ----------
    normals : (N, 3) unit, facing camera 1, in the frame of the Jacobians; NaN where invalid.
    valid : (N,) bool.
    sigma_rad : (N,) predicted rms angular error; NaN where unknown. For small errors it is the root of the trace of
        the normal's covariance. It is bounded: about a radian where the normal is hardly determined.
    """

    normals: Normals
    valid: BoolArray
    sigma_rad: FloatArray


def normals_from_affines(J1: FloatArray, J2: FloatArray, A21: Affines) -> tuple[Normals, BoolArray]:
    """Return the unit normals (N, 3), facing camera 1, whose affinities are nearest to A21, and which are valid.

    Parameters
    ----------
    J1, J2 : (N, 2, 3) d pixel / d point of both images in the frame of the normals (`pair_projection_jacobians`).
    A21 : (N, 2, 2) affinities, NaN where unknown.

    Notes
    -----
    With A(n) = G - h y^T, n ~ J1^T y + d, the minimum of |A(n) - A|_F is y = (G - A)^T h / (h . h). Invalid (NaN)
    without parallax, h = 0 (a point at the epipole, or coincident cameras).

    Raises InputError for arrays of other shapes or types.
    """
    J1, J2, A21 = _matching(J1, J2, A21)
    out = np.empty((len(A21), 3))
    for block in blocks(len(A21)):
        out[block] = _optimal(_planar(J1[block]), _planar(J2[block]), _planar(A21[block]))
    valid = finite(out)
    out[~valid] = np.nan
    return out, valid


def _matching(J1: FloatArray, J2: FloatArray, A21: Affines) -> tuple[FloatArray, FloatArray, Affines]:
    """Return the three as float64; raises InputError where they are not of the same N points."""
    J1, J2, A21 = as_floats(J1, (2, 3), "J1"), as_floats(J2, (2, 3), "J2"), as_floats(A21, (2, 2), "A21")
    n = len(J1)
    if J1.shape != (n, 2, 3) or J2.shape != (n, 2, 3) or A21.shape != (n, 2, 2):
        raise InputError(
            f"normals: J1 and J2 of shape (N, 2, 3) and A21 of (N, 2, 2) are needed, got {J1.shape}, {J2.shape} and "
            f"{A21.shape}"
        )
    return J1, J2, A21


def estimate_normals(
    J1: FloatArray,
    J2: FloatArray,
    A21: Affines,
    *,
    covariance: FloatArray | None = None,
    geometry: FloatArray | None = None,
) -> NormalEstimate:
    """Return the optimal normals with their predicted error.

    Parameters
    ----------
    J1, J2, A21 : as in `normals_from_affines`.
    covariance : (N, 4, 4) of vec(A21), from `Affinities.covariance`; None: the error is unknown.
    geometry : (N, 3, 3) covariance due to corners and pose, rad^2, from `geometry_covariance`.

    Notes
    -----
    dy = -dA^T h / (h . h): the error is the affinity's error along the epipolar line over |h| = |d pixel2 / d range|.
    It grows without bound for small baselines, far planes and points near the epipole.
    """
    normals, valid = normals_from_affines(J1, J2, A21)
    if covariance is None:
        return NormalEstimate(normals, valid, np.full(len(A21), np.nan))
    h = linear_gauge(J1, J2).h
    with np.errstate(divide="ignore", invalid="ignore"):
        along = h / np.sum(h * h, axis=-1, keepdims=True)
    spread_y = np.einsum("ni,nijkl,nk->njl", along, covariance.reshape(-1, 2, 2, 2, 2), along)
    square = _rms_angle(J1, normals, spread_y) ** 2
    if geometry is not None:
        square = square + np.trace(geometry, axis1=-2, axis2=-1)
    return NormalEstimate(normals, valid, np.sqrt(square))


def _rms_angle(J1: FloatArray, normals: Normals, spread_y: FloatArray) -> FloatArray:
    """Return the rms angle (N,) between the normals and those at four sigma points of y.

    The sigma points y +- sqrt(2) L e_i have weight 1/4: exact to first order, and bounded for large errors.
    """
    ray = np.cross(J1[:, 0], J1[:, 1])
    with np.errstate(divide="ignore", invalid="ignore"):
        ray /= np.linalg.norm(ray, axis=-1, keepdims=True)
        gauge = normals / np.sum(normals * ray, axis=-1, keepdims=True)
        first = np.sqrt(spread_y[:, 0, 0])
        cross = np.where(first > 0.0, spread_y[:, 0, 1] / np.where(first > 0.0, first, 1.0), 0.0)
        second = np.sqrt(np.maximum(spread_y[:, 1, 1] - cross * cross, 0.0))
    total = np.zeros(len(normals))
    for a, b in ((first, cross), (np.zeros_like(first), second)):
        step = np.sqrt(2.0) * (J1[:, 0] * a[:, None] + J1[:, 1] * b[:, None])
        total += angle_between(gauge, gauge + step) ** 2 + angle_between(gauge, gauge - step) ** 2
    return np.asarray(np.sqrt(total / 4.0))


def _optimal(J1: FloatArray, J2: FloatArray, A21: Affines) -> Normals:
    """Return -unit(J1^T y + d), NaN without parallax. In this gauge n . d = 1, so that -n faces camera 1."""
    G, h, d = linear_gauge(J1, J2)
    hx, hy = h[:, 0], h[:, 1]
    j = J2.reshape(len(J2), 6)
    size = sum(j[:, k] * j[:, k] for k in range(6))
    with np.errstate(divide="ignore", invalid="ignore"):
        square = hx * hx + hy * hy
        inverse = 1.0 / np.where(square > MIN_PARALLAX**2 * size, square, np.nan)
        px, py = hx * inverse, hy * inverse
        y0 = (G[:, 0, 0] - A21[:, 0, 0]) * px + (G[:, 1, 0] - A21[:, 1, 0]) * py
        y1 = (G[:, 0, 1] - A21[:, 0, 1]) * px + (G[:, 1, 1] - A21[:, 1, 1]) * py
    out = np.empty((len(y0), 3))
    for i in range(3):
        out[:, i] = -(J1[:, 0, i] * y0 + J1[:, 1, i] * y1 + d[:, i])
    out /= np.sqrt(out[:, 0] ** 2 + out[:, 1] ** 2 + out[:, 2] ** 2)[:, None]
    return out


def _planar(array: FloatArray) -> FloatArray:
    """Return the array with its first axis contiguous in memory, so that single components are contiguous."""
    return np.moveaxis(np.ascontiguousarray(np.moveaxis(array, 0, -1)), -1, 0)


class LinearGauge(NamedTuple):
    """A = G - h y^T for the surface n ~ J1^T y + d, which makes the affinity linear in y (2,).

    Attributes
    ----------
    G : (..., 2, 2) affinity of the surface perpendicular to the ray of camera 1.
    h : (..., 2) d pixel2 / d range1, px/mm, along the epipolar line of image 2. Zero at the epipole.
    d : (..., 3) unit viewing ray of camera 1.
    """

    G: Affines
    h: FloatArray
    d: FloatArray


def linear_gauge(J1: FloatArray, J2: FloatArray) -> LinearGauge:
    """Return the gauge n . d = 1 from d pixel / d point (..., 2, 3) of both images, in one frame, for central cameras.

    Notes
    -----
    d = unit(grad u1 x grad v1), G = J2 J1^T (J1 J1^T)^-1, h = J2 d. Equivalent to the form of Molnar and Chetverikov
    that Hajder uses (tests/affine/test_surface.py, with an erratum).
    """
    ux, uy, uz = (J1[..., 0, i] for i in range(3))
    vx, vy, vz = (J1[..., 1, i] for i in range(3))
    d = np.empty((*J1.shape[:-2], 3))
    d[..., 0], d[..., 1], d[..., 2] = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx
    with np.errstate(divide="ignore", invalid="ignore"):
        d /= np.sqrt(d[..., 0] ** 2 + d[..., 1] ** 2 + d[..., 2] ** 2)[..., None]
        uu, uv, vv = ux * ux + uy * uy + uz * uz, ux * vx + uy * vy + uz * vz, vx * vx + vy * vy + vz * vz
        inverse = 1.0 / (uu * vv - uv * uv)
    G = np.empty((*J1.shape[:-2], 2, 2))
    h = np.empty((*J1.shape[:-2], 2))
    for row in (0, 1):
        jx, jy, jz = (J2[..., row, i] for i in range(3))
        ju, jv = jx * ux + jy * uy + jz * uz, jx * vx + jy * vy + jz * vz
        G[..., row, 0] = (ju * vv - jv * uv) * inverse
        G[..., row, 1] = (jv * uu - ju * uv) * inverse
        h[..., row] = jx * d[..., 0] + jy * d[..., 1] + jz * d[..., 2]
    return LinearGauge(G, h, d)


def affines_from_normals(J1: FloatArray, J2: FloatArray, normals: Normals) -> tuple[Affines, BoolArray]:
    """Return A21 (..., 2, 2) of surfaces with `normals` (..., 3; of any length and sign), and which are valid.

    Invalid (NaN) where camera 1 sees the surface edge-on. J1, J2: d pixel / d point (..., 2, 3) in the normals' frame.
    """
    G, h, d = linear_gauge(J1, J2)
    n = np.asarray(normals, dtype=np.float64)
    uu, uv, vv = (np.sum(J1[..., i, :] * J1[..., j, :], axis=-1) for i, j in ((0, 0), (0, 1), (1, 1)))
    nu, nv, nd = np.sum(J1[..., 0, :] * n, axis=-1), np.sum(J1[..., 1, :] * n, axis=-1), np.sum(n * d, axis=-1)
    with np.errstate(divide="ignore", invalid="ignore"):
        scale = 1.0 / ((uu * vv - uv * uv) * nd)
        y = np.stack([(nu * vv - nv * uv) * scale, (nv * uu - nu * uv) * scale], axis=-1)
        A21 = G - h[..., :, None] * y[..., None, :]
    valid = np.isfinite(A21).all(axis=(-2, -1))
    return np.where(valid[..., None, None], A21, np.nan), valid


def geometry_covariance(
    matches: Matches,
    cam2_from_cam1: Rigid3,
    A21: Affines | Callable[[EpipolarNormals], Affines],
    pose_covariance: FloatArray | None = None,
) -> FloatArray:
    """Return the covariance (N, 3, 3) of the unit normals, rad^2, from corner and pose errors at fixed directions.

    It is added to that from the affinities by `estimate_normals(..., geometry=)`.

    Parameters
    ----------
    matches : the corners, with their sigmas.
    cam2_from_cam1 : relative pose; points are triangulated with it.
    A21 : (N, 2, 2); for F2UDIR and F3UDIR, whose affinities depend on the epipolar geometry, the function that computes
        them from it.
    pose_covariance : (6, 6) of (left rotation perturbation rad, translation); None: the pose is exact.
    """
    f1, f2, b1, b2 = matches.rays1, matches.rays2, matches.jacobians1, matches.jacobians2

    def normals(corner1: FloatArray, corner2: FloatArray, pose: Rigid3) -> FloatArray:
        g1, c1 = _moved(f1, b1, corner1)
        g2, c2 = _moved(f2, b2, corner2)
        affines = A21
        if callable(affines):
            E21 = skew(pose.translation_mm) @ pose.rotation
            affines = affines(EpipolarNormals.from_rays(g1, c1, g2, c2, E21))
        points, _ = triangulate_midpoint(g1, g2, pose)
        J1, J2 = pair_projection_jacobians(points, g1, c1, g2, c2, pose)
        return normals_from_affines(J1, J2, affines)[0]

    still = np.zeros(2)
    total = np.zeros((len(f1), 3, 3))
    for axis in np.eye(2):
        step = STEP_PX * axis
        for sigma, plus, minus in (
            (matches.sigma1_px, normals(step, still, cam2_from_cam1), normals(-step, still, cam2_from_cam1)),
            (matches.sigma2_px, normals(still, step, cam2_from_cam1), normals(still, -step, cam2_from_cam1)),
        ):
            change = (plus - minus) / (2.0 * STEP_PX) * sigma[:, None]
            total += change[:, :, None] * change[:, None, :]
    if pose_covariance is not None:
        steps = np.repeat([STEP_RAD, BASELINE_STEP * np.linalg.norm(cam2_from_cam1.translation_mm)], 3)
        columns = []
        for step in np.diag(steps):
            plus, minus = (normals(still, still, cam2_from_cam1.moved(s * step)) for s in (1.0, -1.0))
            columns.append((plus - minus) / (2.0 * step.sum()))
        by_pose = np.stack(columns, axis=-1)
        total += by_pose @ pose_covariance @ np.swapaxes(by_pose, -1, -2)
    return total


def _moved(rays: Rays, jacobians: RayJacobians, step_px: FloatArray) -> tuple[Rays, RayJacobians]:
    """Return rays and Jacobians at pixels displaced by `step_px`; the Jacobian rotates with the ray.

    Changes of the magnification are neglected: they are step / focal length, far less than the noise of directions.
    """
    if not step_px.any():
        return rays, jacobians
    moved = unit(rays + jacobians @ step_px)
    turn = exp_so3(np.cross(rays, moved))
    return moved, turn @ jacobians
