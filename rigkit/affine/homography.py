"""Affinities and homographies: A from H, H from a plane, H from affinities."""

from __future__ import annotations

import math

import numpy as np

from rigkit.core.arrays import Affines, BoolArray, Mat3, Normals, Pixels, as_array, as_floats
from rigkit.core.errors import DegenerateError, InputError
from rigkit.geometry.rigid3 import Rigid3

DEGENERATE = 1e-10
"""Smallest relative eighth singular value of a system on nine unknowns with a unique null vector."""


def affines_from_homography(H21: Mat3, pixels1: Pixels) -> tuple[Affines, BoolArray]:
    """Return d pixel2 / d pixel1 (N, 2, 2) of H21 (3, 3) or (N, 3, 3) at pixels1 (N, 2), and which are valid.

    Invalid (NaN) where the homography maps the pixel to infinity.

    Notes
    -----
    A = (H[:2, :2] - q2 H[2, :2]) / (H[2] q1^). Erratum: the paper prints a2 = (h2 - h8 v2)/s and a3 = (h4 - h7 u2)/s;
    it is a2 = (h2 - h8 u2)/s and a3 = (h4 - h7 v2)/s (tests/affine/test_homography.py).
    """
    h = as_floats(H21, (3, 3), "H21")
    q = as_floats(pixels1, (2,), "pixels1")
    if h.shape[:-2] not in ((), q.shape[:-1]):
        raise InputError(f"H21: one homography, or one a pixel, got {h.shape} for pixels {q.shape}")
    mapped = np.einsum("...ij,...j->...i", h[..., :, :2], q) + h[..., :, 2]
    with np.errstate(divide="ignore", invalid="ignore"):
        s = mapped[..., 2, None, None]
        out = (h[..., :2, :2] - (mapped[..., :2, None] / s) * h[..., 2:, :2]) / s
    valid = np.isfinite(out).all(axis=(-2, -1))
    return np.where(valid[..., None, None], out, np.nan), valid


def homography_from_plane(K1: Mat3, K2: Mat3, cam2_from_cam1: Rigid3, normal: Normals, offset_mm: float) -> Mat3:
    """Return H21 (3, 3), scaled to unit Frobenius norm, of the plane normal . x = offset_mm in the frame of camera 1.

    H = K2 (R + t n^T / D) K1^-1. Raises DegenerateError if the plane contains the centre of camera 1.
    """
    if offset_mm == 0.0:
        raise DegenerateError("homography of a plane: the plane goes through the centre of camera 1")
    n, K1, K2 = as_array(normal, (3,), "normal"), as_array(K1, (3, 3), "K1"), as_array(K2, (3, 3), "K2")
    if not math.isfinite(offset_mm) or np.linalg.matrix_rank(K1) < 3:
        raise InputError("homography of a plane: the offset is no number, or K1 has no inverse")
    euclidean = cam2_from_cam1.rotation + np.outer(cam2_from_cam1.translation_mm, n) / offset_mm
    H21 = K2 @ euclidean @ np.linalg.inv(K1)
    return np.asarray(H21 / np.linalg.norm(H21))


def homography_from_affines(pixels1: Pixels, pixels2: Pixels, A21: Affines, *, affine_weight: float = 1.0) -> Mat3:
    """Return the homography (3, 3), unit Frobenius norm, of N >= 2 points with affinities on one plane.

    Raises InputError: fewer than two points, shapes that do not fit, numbers that are not finite; DegenerateError: the
    points and affinities do not determine a homography (all points equal, affinities singular).

    Parameters
    ----------
    pixels1, pixels2 : (N, 2)
    A21 : (N, 2, 2)
    affine_weight : of the affinities' equations against the points' in normalised coordinates; sigma_px T / sigma_A
        with T the normalisation (about sqrt(2) over the points' spread in px) is the ratio of their noise.

    Notes
    -----
    A point gives the two rows of the direct linear transform, an affinity H[r, c] - q2_r H[2, c] - a_rc (H[2] q1^) = 0.
    """
    q1, q2, A = as_floats(pixels1, (2,), "pixels1"), as_floats(pixels2, (2,), "pixels2"), as_floats(A21, (2, 2), "A21")
    n = len(q1)
    if n < 2 or q1.shape != (n, 2) or q2.shape != (n, 2) or A.shape != (n, 2, 2):
        raise InputError(f"homography from affinities: two points or more with pixels and affinities, got {q1.shape}")
    if not all(np.isfinite(v).all() for v in (q1, q2, A)):
        raise InputError("homography from affinities: pixels or affinities are NaN or infinite; leave those points out")
    T1, T2 = _normalisation(q1), _normalisation(q2)
    x1, x2 = q1 * T1[0, 0] + T1[:2, 2], q2 * T2[0, 0] + T2[:2, 2]
    A = A * (T2[0, 0] / T1[0, 0])
    x1h = np.concatenate([x1, np.ones((n, 1))], axis=1)
    points = np.zeros((n, 2, 3, 3))
    affine = np.zeros((n, 2, 2, 3, 3))
    for r in range(2):
        points[:, r, r] = x1h
        points[:, r, 2] = -x2[:, r, None] * x1h
        for c in range(2):
            affine[:, r, c, r, c] = 1.0
            affine[:, r, c, 2, c] = -x2[:, r]
            affine[:, r, c, 2] -= A[:, r, c, None] * x1h
    system = np.concatenate([points.reshape(-1, 9), affine_weight * affine.reshape(-1, 9)])
    if not np.isfinite(system).all():
        raise InputError("homography from affinities: pixels or affinities are too large to be squared")
    _, singular, vt = np.linalg.svd(system, full_matrices=False)
    if singular[7] < DEGENERATE * singular[0]:
        raise DegenerateError("homography from affinities: points and affinities do not determine it")
    H21 = np.linalg.inv(T2) @ vt[-1].reshape(3, 3) @ T1
    H21 /= np.linalg.norm(H21)
    return np.asarray(H21 if np.median(q1 @ H21[2, :2] + H21[2, 2]) > 0.0 else -H21)


def _normalisation(pixels: Pixels) -> Mat3:
    """Return the similarity that centres the points and makes their mean distance from the origin sqrt(2)."""
    if not len(pixels):
        return np.eye(3)
    centre = pixels.mean(axis=0)
    spread = np.linalg.norm(pixels - centre, axis=1).mean()
    s = np.sqrt(2.0) / spread if spread > 0.0 else 1.0
    return np.array([[s, 0.0, -s * centre[0]], [0.0, s, -s * centre[1]], [0.0, 0.0, 1.0]])
