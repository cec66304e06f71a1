"""Poses from coplanar points, for which the linear epipolar solvers are degenerate.

f2 ~ H f1 with H = R + t n^T / d (plane n . X = d in the frame of camera 1). H is estimated linearly and decomposed into
two poses (Ma, Soatto, Kosecka, Sastry, "An Invitation to 3-D Vision", 5.3.3). If both put all points in front of both
cameras, the points do not determine the pose.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from rigkit.core.arrays import BoolArray, FloatArray, Mat3, Rays
from rigkit.core.errors import DegenerateError
from rigkit.core.matches import Matches
from rigkit.geometry.rigid3 import Rigid3
from rigkit.geometry.rotation import cross, nearest_rotation, rotation_angle, skew, unit
from rigkit.relative_pose.solvers.estimate import check_baseline, transfer_error
from rigkit.relative_pose.solvers.pose import parallax_sigma
from rigkit.relative_pose.solvers.rows import right_singular
from rigkit.relative_pose.solvers.weights import RowWeights

SAME_POSE = 5e-3
"""Poses that differ by less (rotation in rad, translation over baseline) count as one."""
ONE_PLANE_MAX_SIGMAS = 3.0
"""Points may lie on one plane if their rms transfer error is at most this many sigmas."""
AT_REST_SIGMAS = 3.3
"""A parallax, or its deviation from that of a plane, is noise below: one inlier in a thousand exceeds it."""
PLANE_EXPLAINS_SIGMAS = 4.0
"""A plane explains the matches if its chi square exceeds the expected one by fewer standard deviations than this."""
HOMOGRAPHY_FREEDOM = 8
MIN_PLANE_POINTS = 4
"""Points that determine a homography."""
NEARLY_ALL = 0.9
"""Share that counts as all: a few outliers fit by chance, and a few points appear beyond the horizon of their plane."""
PLANE_ROUNDS = 5
"""Reweightings: if half of the points lie on a plane, each one halves their median residual until that is noise."""


def homography_of_rays(matches: Matches) -> Mat3:
    """Return H21 (3, 3), f2 ~ H f1, with middle singular value 1 and f2 . H f1 > 0 for most points."""
    rows = (skew(matches.rays2)[:, :, :, None] * matches.rays1[:, None, None, :]).reshape(-1, 9)
    H = right_singular(rows)[1][-1].reshape(3, 3)
    side = np.sum(matches.rays2 * (matches.rays1 @ H.T), axis=1)
    H = H if np.median(side) >= 0.0 else -H
    middle = np.linalg.svd(H, compute_uv=False)[1]
    return np.asarray(H / (middle if middle > 0.0 else 1.0))


def decompose_homography(H21: Mat3) -> tuple[tuple[Rigid3, FloatArray], ...]:
    """Return up to four poses (translation in units of the plane's distance) and plane normals of `H21`.

    The result is empty for a rotation (all singular values equal), which has no baseline.
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


def refuse_planar_ambiguity(matches: Matches, weights: RowWeights) -> None:
    """Raise DegenerateError if one plane explains the points and affinities with weights to within their noise.

    Affinities that contradict the plane of the points determine the geometry. If affinities have a weight but no sigma,
    the test is not possible and nothing is raised.

    Notes
    -----
    On a plane F = [t]_x H fits for every t: the solution of a linear solver depends on the noise only.
    """
    with_point, with_affinity = weights.points > 0.0, weights.affinities > 0.0
    freedom = 2 * int(with_point.sum()) + 4 * int(with_affinity.sum()) - HOMOGRAPHY_FREEDOM
    if with_point.sum() < 4 or freedom <= 0 or not np.isfinite(weights.sigma_A[with_affinity]).all():
        return
    points = matches.select(with_point)
    H21 = homography_of_rays(points)
    A = _affinities_of(points, H21)
    sigma1, sigma2 = points.sigma1_px[:, None, None], points.sigma2_px[:, None, None]
    covariance = sigma2**2 * np.eye(2) + sigma1**2 * (A @ np.swapaxes(A, -1, -2))
    off = transfer_error(points, H21)
    chi2 = float(np.sum(off * np.linalg.solve(covariance, off[..., None])[..., 0]))
    if matches.A21 is not None:
        by_affinity = matches.A21[with_affinity] - _affinities_of(matches.select(with_affinity), H21)
        chi2 += float(np.sum((by_affinity / weights.sigma_A[with_affinity, None, None]) ** 2))
    if chi2 < freedom + PLANE_EXPLAINS_SIGMAS * np.sqrt(2.0 * freedom):
        raise DegenerateError(
            f"the {len(points)} matches lie on one plane to within their noise, which leaves a general epipolar "
            "geometry open; add points off that plane or declare the pose type"
        )


def _affinities_of(matches: Matches, H21: Mat3) -> FloatArray:
    """Return the affinities (N, 2, 2) that the homography has at the matches."""
    mapped = matches.rays1 @ H21.T
    u, B = unit(mapped), np.swapaxes(matches.jacobians2, -1, -2)
    moved = H21 @ matches.jacobians1 / np.linalg.norm(mapped, axis=1)[:, None, None]
    across = moved - u[:, :, None] * (u[:, None, :] @ moved)
    return np.asarray(np.linalg.solve(B @ matches.jacobians2, B @ across))


def ambiguous_poses(matches: Matches) -> tuple[Rigid3, ...]:
    """Return the poses (unit baseline) of points that may all lie on one plane; none if they do not.

    At most two are returned: those for which the plane is in front of camera 1 at the points. Raises DegenerateError if
    that plane is at infinity, so that a rotation explains the matches.
    """
    if len(matches) < MIN_PLANE_POINTS:
        return ()
    H21 = homography_of_rays(matches)
    square = np.sum(transfer_error(matches, H21) ** 2, axis=1) / (matches.sigma1_px**2 + matches.sigma2_px**2)
    if np.mean(square) > 2.0 * ONE_PLANE_MAX_SIGMAS**2:
        return ()
    check_baseline(matches)
    return _visible(matches.rays1, H21)


def other_ambiguous_poses(matches: Matches, among: BoolArray, noise: float, pose: Rigid3) -> tuple[Rigid3, ...]:
    """Return the other poses (unit baseline) of the plane on which most points lie under `pose`; none without a plane.

    Parameters
    ----------
    among : (N,) matches that fit the epipolar geometry of the pose; a few may be outliers.
    noise : actual noise of the matches, in units of their sigmas.
    pose : unit baseline.

    Raises DegenerateError if a rotation alone explains nearly all of them.

    Notes
    -----
    The parallax of a point on the plane n . x = 1 is |t x f2| (n . f1), linear in n: least squares with Cauchy weights.
    """
    if np.count_nonzero(among) < MIN_PLANE_POINTS:
        return ()
    rays1, f2, t = matches.rays1[among], matches.rays2[among], pose.translation_mm
    across, sigma = cross(t, f2), noise * parallax_sigma(matches)[among]
    reach = np.sqrt(np.sum(across**2, axis=1))
    parallax = np.sum(cross(f2, rays1 @ pose.rotation.T) * unit(across), axis=1) / sigma
    still = np.abs(parallax) < AT_REST_SIGMAS
    if still.mean() > NEARLY_ALL:
        m = matches.select(np.flatnonzero(among)[still])
        check_baseline(replace(m, sigma1_px=noise * m.sigma1_px, sigma2_px=noise * m.sigma2_px))
    rows, weights, before = rays1 * (reach / sigma)[:, None], np.ones(len(f2)), np.inf
    for _ in range(PLANE_ROUNDS):
        weighted = (rows * weights[:, None]).T
        gram = weighted @ rows
        normal = np.linalg.solve(gram + 1e-12 * np.trace(gram) * np.eye(3), weighted @ parallax)
        off = np.abs(parallax - rows @ normal)
        middle = float(np.median(off))
        if middle > max(0.5 * before, AT_REST_SIGMAS):
            return ()
        weights, before = 1.0 / (1.0 + (off / max(1.0, middle)) ** 2), middle
    if not (off < AT_REST_SIGMAS).any():
        return ()
    H21 = pose.rotation + np.outer(t, normal)
    others = _visible(rays1[off < AT_REST_SIGMAS], H21 / np.linalg.svd(H21, compute_uv=False)[1])
    return tuple(other for other in others if not compare_poses(pose, other)[1])


def compare_poses(first: Rigid3, second: Rigid3) -> tuple[float, bool]:
    """Return the angle (rad) between the rotations of two poses (unit baseline), and whether these count as one."""
    difference = first @ second.inverse()
    turn = float(rotation_angle(difference.rotation))
    return turn, max(turn, float(np.linalg.norm(difference.translation_mm))) < SAME_POSE


def _visible(rays1: Rays, H21: Mat3) -> tuple[Rigid3, ...]:
    """Return the poses (unit baseline) of `H21` whose plane is in front of camera 1 at nearly all points."""
    poses = []
    for pose, normal in decompose_homography(H21):
        if np.mean(rays1 @ normal > 0.0) > NEARLY_ALL and np.linalg.norm(pose.translation_mm) > 0.0:
            poses.append(Rigid3(pose.rotation, unit(pose.translation_mm)))
    return tuple(poses)
