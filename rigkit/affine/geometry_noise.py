"""Covariance of normals due to errors of the corners and of the pose, in addition to those of the affinities.

It is usually small. Near an epipole, or with very accurate directions, it limits parallax, range and normal.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from rigkit.affine.affinities import EpipolarNormals
from rigkit.affine.normal import normals_from_affines
from rigkit.core.arrays import Affines, FloatArray, RayJacobians, Rays
from rigkit.core.matches import Matches
from rigkit.geometry.projection_jacobian import pair_projection_jacobians
from rigkit.geometry.rigid3 import Rigid3
from rigkit.geometry.rotation import exp_so3, skew, unit
from rigkit.geometry.triangulation import triangulate_midpoint

STEP_PX = 1e-3
STEP_RAD = 1e-7
BASELINE_STEP = 1e-6
"""Steps of the central differences, with negligible rounding and second-order errors."""


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
