"""Residuals of a relative pose in standard deviations, with their derivatives, for the refinement.

The pose is (R, t), |t| = 1, perturbed by R <- exp(w) R and t <- t + b1 T1 + b2 T2 with T1, T2 perpendicular to t.

Points: the reprojection error, not its first-order (Sampson) approximation. The nearest pair of pixels that satisfies
the epipolar geometry is found by two linearisations. The residual is the signed length of the displacement in sigmas.
By the envelope theorem its derivative is that of the constraint at the corrected rays over its standard deviation.
Affinities: A^T n2 + n1 over its standard deviation, from sigma_A^2 |n2|^2 and the pixels' noise (weights.pixel_share).
"""

from __future__ import annotations

import numpy as np

from rigkit.core.arrays import FloatArray, IntArray
from rigkit.core.matches import Matches
from rigkit.core.posetype import PoseType, axis_of
from rigkit.geometry.rotation import cross, log_so3, skew
from rigkit.geometry.sampson import epipolar_normals
from rigkit.geometry.triangulation import correct_rays_px
from rigkit.relative_pose.solvers.weights import pixel_share, usable_affinities


def point_terms(matches: Matches, R: FloatArray, t: FloatArray, basis: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the signed reprojection distances (N,) in sigmas and their Jacobian (N, 5)."""
    E21 = skew(t) @ R
    b1, b2, s1, s2 = matches.jacobians1, matches.jacobians2, matches.sigma1_px, matches.sigma2_px
    f1, f2, dq1, dq2 = correct_rays_px(
        matches.rays1, matches.rays2, E21, b1, b2, sigma1_px=s1, sigma2_px=s2, iterations=1
    )
    # The ray Jacobians of the measured pixels are used: displacements of a pixel change them negligibly.
    c, n1, n2 = epipolar_normals(E21, f1, f2, b1, b2)
    at_measured = c - np.sum(n1 * dq1, axis=-1) - np.sum(n2 * dq2, axis=-1)
    sigma = np.sqrt(s1**2 * np.sum(n1 * n1, axis=-1) + s2**2 * np.sum(n2 * n2, axis=-1))
    sigma = np.where(sigma > 0.0, sigma, np.inf)
    turned = f1 @ R.T
    by_rotation = cross(turned, cross(f2, t))
    by_direction = cross(turned, f2) @ basis.T
    jacobian = np.concatenate([by_rotation, by_direction], axis=1) / sigma[:, None]
    return at_measured / sigma, jacobian


def affinity_terms(
    matches: Matches, R: FloatArray, t: FloatArray, basis: FloatArray
) -> tuple[FloatArray, FloatArray, IntArray]:
    """Return residuals (K, 2) in sigmas of the affinities with a sigma_A, their Jacobian (K, 2, 5) and matches (K,)."""
    which = _chosen(matches)
    if not len(which):
        return np.zeros((0, 2)), np.zeros((0, 2, 5)), which
    m = matches.select(which)
    assert m.A21 is not None and m.sigma_A is not None
    f1, f2, b1, b2, A = m.rays1, m.rays2, m.jacobians1, m.jacobians2, m.A21
    turned = f1 @ R.T
    # E f1 = t x (R f1) and E^T f2 = R^T (f2 x t), and their derivatives by (w, b).
    line2, line1 = cross(t, turned), cross(f2, t)
    by2 = np.concatenate([-skew(t) @ skew(turned), -skew(turned) @ basis.T], axis=-1)
    by1 = np.concatenate([skew(line1), skew(f2) @ basis.T], axis=-1)
    n2 = (line2[:, None, :] @ b2)[:, 0]
    n1 = ((line1 @ R)[:, None, :] @ b1)[:, 0]
    dn2 = np.swapaxes(b2, -1, -2) @ by2
    dn1 = np.swapaxes(b1, -1, -2) @ (R.T @ by1)
    g = (n2[:, None, :] @ A)[:, 0] + n1
    dg = np.swapaxes(A, -1, -2) @ dn2 + dn1
    variance = m.sigma_A**2 * np.sum(n2**2, axis=1) + pixel_share(m, skew(t) @ R)
    variance = np.where(variance > 0.0, variance, np.inf)
    along = m.sigma_A[:, None] ** 2 * np.sum(n2[:, :, None] * dn2, axis=1) + _half_pixel_share_jacobian(m, R, t, basis)
    along /= variance[:, None]
    scale = 1.0 / np.sqrt(variance)
    return g * scale[:, None], (dg - g[:, :, None] * along[:, None, :]) * scale[:, None, None], which


def _half_pixel_share_jacobian(matches: Matches, R: FloatArray, t: FloatArray, basis: FloatArray) -> FloatArray:
    """Return half the derivative (K, 5) of `pixel_share`, which is a sum of squares of M = B2^T E B1 and A^T M."""
    m = matches
    assert m.A21 is not None
    C = R @ m.jacobians1
    M = np.swapaxes(m.jacobians2, -1, -2) @ (skew(t) @ C)
    s1, s2 = (s[:, None, None] ** 2 for s in (m.sigma1_px, m.sigma2_px))
    C, P = (np.swapaxes(v, -1, -2) for v in (C, m.jacobians2 @ (s1 * m.A21 @ np.swapaxes(m.A21, -1, -2) @ M + s2 * M)))
    by_rotation, by_direction = cross(C, cross(P, t)).sum(axis=1), cross(C, P).sum(axis=1)
    return 0.5 * np.concatenate([by_rotation, by_direction @ basis.T], axis=1)


def whitened_affinities(matches: Matches) -> tuple[FloatArray, IntArray]:
    """Return the input of `affinity_terms` in the memory layout of its kernel, (25, K), and which matches (K,).

    The rows are the rays of both images, the columns of their ray Jacobians, the entries of A21, and the variances of
    an entry of A21 and of the pixels of both images.
    """
    which = _chosen(matches)
    if not len(which):
        return np.zeros((25, 0)), which
    assert matches.A21 is not None and matches.sigma_A is not None
    columns = [b[which].T.reshape(6, -1) for b in (matches.jacobians1, matches.jacobians2)]
    entries = matches.A21[which].reshape(-1, 4).T
    rays = matches.rays1[which].T, matches.rays2[which].T
    sigmas = np.stack([matches.sigma_A[which], matches.sigma1_px[which], matches.sigma2_px[which]])
    return np.concatenate([*rays, *columns, entries, sigmas**2]), which


def _chosen(matches: Matches) -> IntArray:
    """Return the indices (K,) of the matches with an affinity and its sigma_A."""
    if matches.sigma_A is None:
        return np.zeros(0, dtype=np.int64)
    known = np.isfinite(matches.sigma_A) & (matches.sigma_A > 0.0)
    return np.flatnonzero(usable_affinities(matches) & known).astype(np.int64)


def level_terms(
    pose_type: PoseType | str, R: FloatArray, t: FloatArray, basis: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return the deviations (K,), rad, of a pose from its type, and their Jacobian (K, 5).

    Planar: the x and z components of the rotated vertical axis, and t_y. Standard and forward: the rotation vector and
    the two components of t perpendicular to x or z. General: none.
    """
    kind = str(pose_type)
    if kind == PoseType.PLANAR:
        vertical = R[:, 1]
        values = np.array([vertical[0], vertical[2], t[1]])
        by_rotation = np.concatenate([-skew(vertical)[[0, 2]], np.zeros((1, 3))])
        by_direction = np.concatenate([np.zeros((2, 2)), basis[:, 1][None]])
        return values, np.concatenate([by_rotation, by_direction], axis=1)
    if (along := axis_of(kind)) is not None:
        across = np.delete(np.arange(3), along)
        jacobian = np.zeros((5, 5))
        # d log(exp(w) R) = dw for small rotations, the only ones for which this prior matters.
        jacobian[:3, :3] = np.eye(3)
        jacobian[3:, 3:] = basis[:, across].T
        return np.concatenate([log_so3(R), t[across]]), jacobian
    return np.zeros(0), np.zeros((0, 5))
