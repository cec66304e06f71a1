"""The normalised linear solution: eight points, three affine correspondences, or more of both.

Normalisation is by the second moment of the rays: T_i = (mean f f^T)^(-1/2), which for a narrow field of view is what
Hartley's translation and scaling do to pixels and serves the widest fisheye alike.
"""

from __future__ import annotations

import numpy as np

from rigkit.core.arrays import FloatArray, Mat3
from rigkit.core.errors import DegenerateError
from rigkit.core.matches import Matches
from rigkit.relative_pose.solvers.rows import affinity_rows, point_rows, right_singular
from rigkit.relative_pose.solvers.weights import RowWeights


class NormalisedRows:
    """The rows of all matches in normalised coordinates; the weights come later."""

    def __init__(self, matches: Matches) -> None:
        self.transform1, self.transform2 = _whitening(matches.rays1), _whitening(matches.rays2)
        x1, x2 = matches.rays1 @ self.transform1.T, matches.rays2 @ self.transform2.T
        self.points = point_rows(x1, x2)
        self.affinities: FloatArray | None = None
        if matches.A21 is not None:
            d1, d2 = self.transform1 @ matches.jacobians1, self.transform2 @ matches.jacobians2
            self.affinities = affinity_rows(x1, x2, d1, d2, np.nan_to_num(matches.A21))

    def weighted(self, weights: RowWeights) -> FloatArray:
        """Return the rows that count (M, 9), multiplied by their weights."""
        use = weights.points > 0.0
        rows = self.points[use] * weights.points[use, None]
        also = weights.affinities > 0.0
        if self.affinities is not None and also.any():
            more = self.affinities[also] * weights.affinities[also, None, None]
            rows = np.concatenate([rows, more.reshape(-1, 9)])
        return rows

    def denormalised(self, f: FloatArray) -> FloatArray:
        """Return (..., 3, 3) on rays of solutions (..., 9) in normalised coordinates."""
        matrix = f.reshape(*f.shape[:-1], 3, 3)
        return np.asarray(self.transform2.T @ matrix @ self.transform1)


def linear_epipolar(rows: NormalisedRows, weights: RowWeights) -> Mat3:
    """Return the rank-two matrix (3, 3) on rays (unit norm) that minimises the weighted algebraic error.

    Raises DegenerateError where a second solution fits exactly too (all points on one plane, or no baseline).
    """
    s, vt = right_singular(rows.weighted(weights))
    if s[7] < 1e-9 * s[0]:
        raise DegenerateError(
            "the matches do not determine a general epipolar geometry (all on one plane, or no baseline); "
            "add points off that plane or declare the pose type"
        )
    u, s3, wt = np.linalg.svd(vt[8].reshape(3, 3))
    flat = ((u * [s3[0], s3[1], 0.0]) @ wt).reshape(9)
    matrix = rows.denormalised(flat)
    return np.asarray(matrix / np.linalg.norm(matrix))


def essential_nearest(matrix: FloatArray) -> Mat3:
    """Return the essential matrices (..., 3, 3) of unit Frobenius norm nearest to the given ones."""
    u, _, vt = np.linalg.svd(matrix)
    return np.asarray((u[..., :, :2] @ vt[..., :2, :]) * np.sqrt(0.5))


def _whitening(rays: FloatArray) -> Mat3:
    moment = rays.T @ rays / len(rays)
    values, vectors = np.linalg.eigh(moment)
    # Coplanar rays have a zero moment across their plane: leave that direction as small as it is.
    values = np.maximum(values, 1e-12 * values[-1])
    return np.asarray((vectors / np.sqrt(values)) @ vectors.T)
