"""The normalised linear solution: eight points, three affine correspondences, or more of both.

Rays are normalised by their second moment, T_i = (mean f f^T)^(-1/2). For a narrow field of view this is equivalent to
translation and scaling of pixels (R. Hartley, "In defense of the eight-point algorithm", 1997); it also works for the
widest fisheye.
"""

from __future__ import annotations

import numpy as np

from rigkit.core.arrays import FloatArray, Mat3
from rigkit.core.errors import DegenerateError
from rigkit.core.matches import Matches
from rigkit.relative_pose.solvers.rows import LinearRows, affinity_rows, point_rows, right_singular
from rigkit.relative_pose.solvers.weights import RowWeights


def linear_epipolar(rows: LinearRows, weights: RowWeights) -> Mat3:
    """Return the rank-two matrix (3, 3) in the rows' coordinates that minimises the weighted algebraic error.

    Raises DegenerateError if a second solution fits exactly too (all points on one plane, or no baseline).
    """
    s, vt = right_singular(rows.weighted(weights))
    if s[7] < 1e-9 * s[0]:
        raise DegenerateError(
            "the matches do not determine a general epipolar geometry (all on one plane, or no baseline); "
            "add points off that plane or declare the pose type"
        )
    u, s3, wt = np.linalg.svd(vt[8].reshape(3, 3))
    return np.asarray((u * [s3[0], s3[1], 0.0]) @ wt)


def normalised(m: Matches) -> tuple[LinearRows, Mat3, Mat3]:
    """Return the rows of matches in normalised coordinates, and T1, T2: E on rays is T2^T E T1."""
    T1, T2 = _whitening(m.rays1), _whitening(m.rays2)
    x1, x2, affinities = m.rays1 @ T1.T, m.rays2 @ T2.T, None
    if m.A21 is not None:
        affinities = affinity_rows(x1, x2, T1 @ m.jacobians1, T2 @ m.jacobians2, np.nan_to_num(m.A21))
    return LinearRows(point_rows(x1, x2), affinities), T1, T2


def essential_nearest(matrix: FloatArray) -> Mat3:
    """Return the essential matrices (..., 3, 3) of unit Frobenius norm nearest to the given ones."""
    u, _, vt = np.linalg.svd(matrix)
    return np.asarray((u[..., :, :2] @ vt[..., :2, :]) * np.sqrt(0.5))


def _whitening(rays: FloatArray) -> Mat3:
    moment = rays.T @ rays / len(rays)
    values, vectors = np.linalg.eigh(moment)
    # Coplanar rays have a zero moment across their plane: that direction is not scaled up without limit.
    values = np.maximum(values, 1e-12 * values[-1])
    return np.asarray((vectors / np.sqrt(values)) @ vectors.T)
