"""The relative pose of an essential matrix, chosen by cheirality along rays."""

from __future__ import annotations

import numpy as np

from rigkit.core.arrays import FloatArray, IntArray, Mat3, Rays
from rigkit.core.errors import DegenerateError
from rigkit.core.matches import Matches
from rigkit.core.posetype import PoseType
from rigkit.geometry.rigid3 import Rigid3
from rigkit.geometry.rotation import cross, log_so3, skew
from rigkit.geometry.triangulation import ray_ranges
from rigkit.relative_pose.solvers.weights import px_angles


def essential_from_pose(cam2_from_cam1: Rigid3) -> Mat3:
    """Return E21 = [t]x R with unit Frobenius norm; raises DegenerateError without a baseline."""
    E21 = skew(cam2_from_cam1.translation_mm) @ cam2_from_cam1.rotation
    size = float(np.linalg.norm(E21))
    if size == 0.0:
        raise DegenerateError(
            "no baseline: the pose has a zero translation and no epipolar geometry; take the images from different "
            "places"
        )
    return np.asarray(E21 / size)


def essential_nearest(matrix: FloatArray) -> Mat3:
    """Return the essential matrices (..., 3, 3) of unit Frobenius norm nearest to the given ones."""
    u, _, vt = np.linalg.svd(matrix)
    return np.asarray((u[..., :, :2] @ vt[..., :2, :]) * np.sqrt(0.5))


def rotations_and_direction(E21: Mat3) -> tuple[Mat3, Mat3, FloatArray]:
    """Return two rotations (N, 3, 3) and a unit direction t (N, 3) with E = [t]x R up to scale, for essential E.

    The rotations differ by 180 degrees about the baseline.

    Notes
    -----
    E E^T = I - t t^T with |E|_F^2 = 2, the cofactors of E are t t^T R, and [t]x E is t t^T R - R.
    """
    E = E21 * np.sqrt(2.0 / np.einsum("nij,nij->n", E21, E21))[:, None, None]
    outer = np.eye(3) - E @ np.swapaxes(E, 1, 2)
    every, largest = np.arange(len(E)), np.argmax(np.einsum("nii->ni", outer), axis=1)
    t = outer[every, largest] / np.sqrt(outer[every, largest, largest])[:, None]
    columns = np.swapaxes(E, 1, 2)
    cofactors = np.swapaxes(cross(columns[:, [1, 2, 0]], columns[:, [2, 0, 1]]), 1, 2)
    across = skew(t) @ E
    return cofactors - across, cofactors + across, t


def decompose_essential(E21: Mat3) -> tuple[Rigid3, ...]:
    """Return the four poses cam2_from_cam1 (unit baseline) of the essential matrix nearest to `E21` (3, 3)."""
    first, second, t = rotations_and_direction(essential_nearest(E21)[None])
    return Rigid3.stack(np.concatenate([first, first, second, second]), np.concatenate([t, -t, t, -t]))


def hypothesis_poses(E21: Mat3, pose_type: PoseType | str = PoseType.GENERAL) -> tuple[Rigid3, ...]:
    """Return the poses of `E21` that the pose type allows: four in general, else two.

    Of the two rotations, which differ by 180 degrees about the baseline, the one nearest to the pose type is kept.
    """
    poses = decompose_essential(E21)
    if str(pose_type) == PoseType.GENERAL:
        return poses
    if str(pose_type) == PoseType.PLANAR:
        off = [float(np.linalg.norm(pose.rotation[:, 1] - [0.0, 1.0, 0.0])) for pose in poses]
    else:
        off = [float(np.linalg.norm(log_so3(pose.rotation))) for pose in poses]
    nearest = min(off[0], off[2])
    return tuple(pose for pose, value in zip(poses, off, strict=True) if value <= nearest + 1e-6)


def choose_pose(E21: Mat3, rays1: Rays, rays2: Rays, pose_type: PoseType | str = PoseType.GENERAL) -> Rigid3:
    """Return the pose (unit baseline) for which most points have positive ranges along both rays.

    Raises DegenerateError if no pose does so for more than half of the points, or if the best two have equal counts
    (points at infinity, no baseline).
    """
    poses = hypothesis_poses(E21, pose_type)
    # The poses come in pairs with opposite translations, which invert the signs of all ranges.
    counts = [count for pose in poses[::2] for count in _in_front(pose, rays1, rays2)]
    order = sorted(range(len(poses)), key=counts.__getitem__, reverse=True)
    best, second = counts[order[0]], counts[order[1]]
    if best <= 0.5 * len(rays1) or best == second:
        raise DegenerateError(
            f"cheirality does not decide the pose: the best two hypotheses put {best} and {second} of {len(rays1)} "
            "points in front of both cameras; check that the matches are correct and that there is a baseline"
        )
    return poses[order[0]]


def cheirality_margin(matches: Matches, cam2_from_cam1: Rigid3) -> FloatArray:
    """Return the parallax (N,) in sigmas of the matches behind a camera; 0 for those in front of both.

    It is the change of the pixels that would move the point to infinity, the nearest place that both cameras see.
    """
    range1, range2, defined = ray_ranges(matches.rays1, matches.rays2, cam2_from_cam1)
    behind = defined & ((range1 < 0.0) | (range2 < 0.0))
    parallax = np.linalg.norm(cross(matches.rays2, matches.rays1 @ cam2_from_cam1.rotation.T), axis=1)
    return np.asarray(np.divide(parallax, parallax_sigma(matches), out=np.zeros(len(matches)), where=behind))


def parallax_sigma(matches: Matches) -> FloatArray:
    """Return the standard deviation (N,), rad, of the angle between the rays of each match in a fixed direction."""
    size1, size2 = px_angles(matches)
    return np.asarray(np.hypot(matches.sigma1_px * size1, matches.sigma2_px * size2))


def _in_front(pose: Rigid3, rays1: Rays, rays2: Rays) -> tuple[int, int]:
    """Return how many points lie in front of both cameras, and how many with the opposite translation."""
    range1, range2, defined = ray_ranges(rays1, rays2, pose)
    ahead = [np.sum(defined & (sign * range1 > 0.0) & (sign * range2 > 0.0)) for sign in (1.0, -1.0)]
    return int(ahead[0]), int(ahead[1])


def translation_basis(direction: FloatArray) -> FloatArray:
    """Return an orthonormal basis (..., 2, 3) of the plane perpendicular to `direction` (..., 3); the first vector is
    horizontal."""
    t = np.asarray(direction, dtype=np.float64)
    size = np.hypot(t[..., 0], t[..., 2])[..., None]
    across = np.stack([t[..., 2], np.zeros(t.shape[:-1]), -t[..., 0]], axis=-1)
    first = np.where(size > 1e-9, across / np.maximum(size, 1e-9), [1.0, 0.0, 0.0])
    return np.stack([first, cross(t, first)], axis=-2)


def pose_directions(translation: FloatArray) -> FloatArray:
    """Return the five perturbations (w, b) of a pose of unit baseline, rows (5, 6) of (rotation, translation)."""
    out = np.zeros((5, 6))
    out[:3, :3], out[3:, 3:] = np.eye(3), translation_basis(translation)
    return out


def free_directions(pose_type: PoseType | str) -> IntArray:
    """Return the indices of the free parameters among (w, b): rotation w, direction b along `translation_basis`."""
    return np.array({"general": [0, 1, 2, 3, 4], "planar": [1, 3]}.get(str(pose_type), []), dtype=np.int64)
