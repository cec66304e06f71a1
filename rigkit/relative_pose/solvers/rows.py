"""Linear equations of points and affinities on E, for any central camera.

With rays f, ray Jacobians B and the affinity A of a match, on the row-major vec(E)::

    point      f2 f1^T                                    f2^T E f1 = 0
    affinity j f2 (B1 e_j)^T + (B2 A e_j) f1^T            (A^T n2 + n1)_j = 0

The affinity's rows are the derivatives of the point's row by the pixel of image 1 along the surface. Far from an
epipole their noise is therefore sigma_A |n2|, while that of the point's row is sqrt(sigma1^2 |n1|^2 + sigma2^2 |n2|^2).
Homogeneous pixels (u, v, 1) with the Jacobian [I; 0] give the equations on F.

Reference: D. Barath, L. Hajder, "Efficient recovery of essential matrix from two affine correspondences" (2018), A^T n2
= -n1; I. Eichhardt, D. Barath, "Optimal multi-view correction of local affine frames" (2019), central cameras; L.
Hajder, "Affine Correspondences in Stereo Vision", estimation of F from points and affinities.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rigkit.core.arrays import Affines, FloatArray, RayJacobians, Rays
from rigkit.core.matches import Matches
from rigkit.relative_pose.solvers.weights import RowWeights

PLANAR_ENTRIES = (1, 3, 5, 7)
"""Nonzero entries of the row-major E of planar motion, E = [[0, e1, 0], [e2, 0, e3], [0, e4, 0]]. A rotation by theta
about y and t = (sin phi, 0, cos phi) give e = (-cos phi, cos(phi - theta), -sin(phi - theta), sin phi)."""


def point_rows(rays1: Rays, rays2: Rays) -> FloatArray:
    """Return the rows (..., 9) of points."""
    return np.asarray((rays2[..., :, None] * rays1[..., None, :]).reshape(*rays1.shape[:-1], 9))


def affinity_rows(
    rays1: Rays, rays2: Rays, jacobians1: RayJacobians, jacobians2: RayJacobians, A21: Affines
) -> FloatArray:
    """Return the two rows (..., 2, 9) of affinities."""
    first = rays2[..., None, :, None] * np.swapaxes(jacobians1, -1, -2)[..., :, None, :]
    second = np.swapaxes(jacobians2 @ A21, -1, -2)[..., :, :, None] * rays1[..., None, None, :]
    return np.asarray((first + second).reshape(*rays1.shape[:-1], 2, 9))


@dataclass(frozen=True, eq=False, slots=True)
class LinearRows:
    """The unweighted rows of N matches on K unknowns.

    Attributes
    ----------
    points : (N, K)
    affinities : (N, 2, K), or None without affinities.
    """

    points: FloatArray
    affinities: FloatArray | None

    @classmethod
    def of(cls, m: Matches, family: FloatArray) -> LinearRows:
        """Return the rows of matches on the unknowns x of vec(E) = x `family`, `family` (K, 9)."""
        points, affinities = point_rows(m.rays1, m.rays2) @ family.T, None
        if m.A21 is not None:
            rows = affinity_rows(m.rays1, m.rays2, m.jacobians1, m.jacobians2, np.nan_to_num(m.A21))
            affinities = rows @ family.T
        return cls(points, affinities)

    def weighted(self, weights: RowWeights) -> FloatArray:
        """Return the rows with a positive weight (M, K), multiplied by it."""
        use, also = weights.points > 0.0, weights.affinities > 0.0
        rows = self.points[use] * weights.points[use, None]
        if self.affinities is None or not also.any():
            return rows
        more = self.affinities[also] * weights.affinities[also, None, None]
        return np.concatenate([rows, more.reshape(-1, rows.shape[1])])


def essential_from_planar(e: FloatArray) -> FloatArray:
    """Return E (..., 3, 3) of the planar entries (..., 4)."""
    out = np.zeros((*e.shape[:-1], 9))
    out[..., PLANAR_ENTRIES] = e
    return out.reshape(*e.shape[:-1], 3, 3)


def right_singular(rows: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return all singular values (K,), zeros included, and right singular vectors (K, K) of rows (M, K).

    A QR decomposition reduces thousands of rows to K before the singular value decomposition.
    """
    columns = rows.shape[1]
    square = np.linalg.qr(rows, mode="r") if len(rows) > columns else rows
    _, s, vt = np.linalg.svd(square, full_matrices=True)
    return np.concatenate([s, np.zeros(columns - len(s))]), vt
