"""Sampson distance of ray pairs from an epipolar geometry, in pixels, for any central camera.

With unit rays f, ray Jacobians B = d f / d q (3x2) and E21, the constraint is c = f2^T E f1. Its gradients with respect
to the two pixels, n1 = B1^T E^T f2 and n2 = B2^T E f1, are the normals of the epipolar curves in pixel units. A pinhole
image is the special case in which n1, n2 are the usual line normals (F^T q2)[:2], (F q1)[:2], up to the lengths of the
homogeneous vectors. Reference: Hajder, "Affine Correspondences in Stereo Vision"; Hartley and Zisserman, "Multiple View
Geometry", 11.4.3 (Sampson distance).
"""

from __future__ import annotations

import numpy as np

from rigkit.core.arrays import FloatArray, Mat3, RayJacobians, Rays
from rigkit.core.matches import Matches


def epipolar_normals(
    E21: Mat3, rays1: Rays, rays2: Rays, jacobians1: RayJacobians, jacobians2: RayJacobians
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the constraint c (..., N) and its pixel gradients n1, n2 (..., N, 2).

    `E21` (..., 3, 3), rays (..., N, 3), Jacobians (..., N, 3, 2): leading axes broadcast, so that many hypotheses are
    tested against one set of matches in one call. An affinity A21 of the surface obeys A21^T n2 + n1 = 0.
    """
    line2 = rays1 @ np.swapaxes(E21, -1, -2)
    line1 = rays2 @ E21
    c = np.sum(line2 * rays2, axis=-1)
    n1 = (line1[..., None, :] @ jacobians1)[..., 0, :]
    n2 = (line2[..., None, :] @ jacobians2)[..., 0, :]
    return c, n1, n2


def sampson_distances(
    E21: Mat3,
    rays1: Rays,
    rays2: Rays,
    jacobians1: RayJacobians,
    jacobians2: RayJacobians,
    sigma1_px: FloatArray | float = 1.0,
    sigma2_px: FloatArray | float = 1.0,
) -> FloatArray:
    """Return the signed Sampson distance (..., N) of each pair.

    With the default sigmas it is in px: the distance of the pair of pixels, as one point in 4D, from the epipolar
    geometry. With the corners' sigmas it is in standard deviations. Zero at the epipoles, which fit any partner.
    """
    c, n1, n2 = epipolar_normals(E21, rays1, rays2, jacobians1, jacobians2)
    variance = sigma1_px**2 * np.sum(n1 * n1, axis=-1) + sigma2_px**2 * np.sum(n2 * n2, axis=-1)
    return np.asarray(np.divide(c, np.sqrt(variance), out=np.zeros_like(c), where=variance > 0.0))


def sampson_of_matches(E21: Mat3, m: Matches, *, in_sigmas: bool = False) -> FloatArray:
    """Return the signed Sampson distance (N,) of each match, in px or in standard deviations."""
    sigmas = (m.sigma1_px, m.sigma2_px) if in_sigmas else (1.0, 1.0)
    return sampson_distances(E21, m.rays1, m.rays2, m.jacobians1, m.jacobians2, *sigmas)
