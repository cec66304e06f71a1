"""General motion: F by the normalised eight-point method on points and noise-weighted affinities, E by projection.

Reference: R. Hartley, "In defense of the eight-point algorithm" (1997); L. Hajder, "Affine Correspondences in Stereo
Vision", F from points and affinities: one row per point, two per affinity.

Rays are normalised by their second moment, T_i = (mean f f^T)^(-1/2). For a narrow field of view this is equivalent to
translation and scaling of pixels; it also works for the widest fisheye.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rigkit.core.arrays import FloatArray, Mat3
from rigkit.core.errors import DegenerateError
from rigkit.core.matches import Matches
from rigkit.relative_pose.solvers.estimate import EpipolarEstimate, check_baseline, check_count, finish, reweighted
from rigkit.relative_pose.solvers.planar_ambiguity import refuse_planar_ambiguity
from rigkit.relative_pose.solvers.pose import essential_nearest
from rigkit.relative_pose.solvers.rows import LinearRows, affinity_rows, point_rows, right_singular
from rigkit.relative_pose.solvers.weights import RowWeights, WeightRule


@dataclass(frozen=True, slots=True)
class GeneralSolver:
    """At least eight equations: eight points, three affine correspondences, or a mixture."""

    degrees_of_freedom: int = 7

    def solve(self, matches: Matches, weights: WeightRule | None = None) -> EpipolarEstimate:
        """Return F21 (rank two) and the nearest E21; see FundamentalSolver.

        Raises DegenerateError if one plane explains the matches to within their noise.
        """
        check_baseline(matches)
        rows, T1, T2 = _normalised(matches)

        def linear(row_weights: RowWeights) -> Mat3:
            check_count(matches, row_weights, 8, "general epipolar geometry")
            return np.asarray(T2.T @ _linear_epipolar(rows, row_weights) @ T1)

        matrix, used = reweighted(matches, weights, linear)
        refuse_planar_ambiguity(matches, used)
        return finish(matches, essential_nearest(matrix), matrix, used)


def _linear_epipolar(rows: LinearRows, weights: RowWeights) -> Mat3:
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


def _normalised(m: Matches) -> tuple[LinearRows, Mat3, Mat3]:
    """Return the rows of matches in normalised coordinates, and T1, T2: E on rays is T2^T E T1."""
    T1, T2 = _whitening(m.rays1), _whitening(m.rays2)
    x1, x2, affinities = m.rays1 @ T1.T, m.rays2 @ T2.T, None
    if m.A21 is not None:
        affinities = affinity_rows(x1, x2, T1 @ m.jacobians1, T2 @ m.jacobians2, np.nan_to_num(m.A21))
    return LinearRows(point_rows(x1, x2), affinities), T1, T2


def _whitening(rays: FloatArray) -> Mat3:
    moment = rays.T @ rays / len(rays)
    values, vectors = np.linalg.eigh(moment)
    # Coplanar rays have a zero moment across their plane: that direction is not scaled up without limit.
    values = np.maximum(values, 1e-12 * values[-1])
    return np.asarray((vectors / np.sqrt(values)) @ vectors.T)
