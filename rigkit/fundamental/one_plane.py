"""Poses from points that all lie on one plane, where the linear epipolar solvers are blind.

f2 ~ H f1 with H = R + t n^T / d (plane n . X = d in the frame of camera 1). H comes linearly, two poses from its
singular vectors (Ma, Soatto, Kosecka, Sastry, "An Invitation to 3-D Vision", 5.3.3). Often both put all points in
front of both cameras: then one plane does not determine the pose and no algorithm can.
"""

from __future__ import annotations

import numpy as np

from rigkit.arrays import FloatArray, Mat3
from rigkit.fundamental.estimate import check_baseline, transfer_error
from rigkit.fundamental.rows import right_singular
from rigkit.geometry.rigid3 import Rigid3
from rigkit.geometry.rotation import nearest_rotation, skew, unit
from rigkit.matches import Matches

__all__ = ["decompose_homography", "homography_of_rays", "one_plane_poses"]

ONE_PLANE_SIGMAS = 3.0
"""Points whose homography transfers them within so many sigmas (rms) may lie on one plane."""


def homography_of_rays(matches: Matches) -> Mat3:
    """Return H21 (3, 3) with f2 ~ H f1, middle singular value 1, and f2 . H f1 > 0 for most points."""
    rows = (skew(matches.rays2)[:, :, :, None] * matches.rays1[:, None, None, :]).reshape(-1, 9)
    H = right_singular(rows)[1][-1].reshape(3, 3)
    side = np.sum(matches.rays2 * (matches.rays1 @ H.T), axis=1)
    H = H if np.median(side) >= 0.0 else -H
    middle = np.linalg.svd(H, compute_uv=False)[1]
    return np.asarray(H / (middle if middle > 0.0 else 1.0))


def decompose_homography(H21: Mat3) -> tuple[tuple[Rigid3, FloatArray], ...]:
    """Return the poses (translation in units of the plane's distance) and plane normals of `H21`, up to four.

    Nothing for a rotation (all singular values equal): there is no baseline.
    """
    values, vectors = np.linalg.eigh(H21.T @ H21)
    v3, v2, v1 = vectors.T
    low, high = values[0], values[2]
    if high - low < 1e-12:
        return ()
    lean, rest = np.sqrt(max(1.0 - low, 0.0)), np.sqrt(max(high - 1.0, 0.0))
    out = []
    for sign in (1.0, -1.0):
        u = unit(lean * v1 + sign * rest * v3)
        normal = np.cross(v2, u)
        before = np.stack([v2, u, normal], axis=1)
        after = np.stack([H21 @ v2, H21 @ u, np.cross(H21 @ v2, H21 @ u)], axis=1)
        R = nearest_rotation(after @ before.T)
        t = (H21 - R) @ normal
        out += [(Rigid3(R, t), normal), (Rigid3(R, -t), -normal)]
    return tuple(out)


def one_plane_poses(matches: Matches) -> tuple[Rigid3, ...]:
    """Return the poses (unit baseline) of the plane that all points may lie on; nothing if they do not lie on one.

    Only poses with all points on the visible side of the plane's half-space, d > 0, are returned: at most two. Raises
    DegenerateError where that plane is at infinity: a rotation explains the matches.
    """
    if len(matches) < 4:
        return ()
    H21 = homography_of_rays(matches)
    square = np.sum(transfer_error(matches, H21) ** 2, axis=1) / (matches.sigma1_px**2 + matches.sigma2_px**2)
    if np.mean(square) > 2.0 * ONE_PLANE_SIGMAS**2:
        return ()
    check_baseline(matches)
    poses = []
    for pose, normal in decompose_homography(H21):
        if np.mean(matches.rays1 @ normal > 0.0) > 0.9 and np.linalg.norm(pose.translation_mm) > 0.0:
            poses.append(Rigid3(pose.rotation, unit(pose.translation_mm)))
    return tuple(poses)
