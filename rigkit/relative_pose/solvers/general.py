"""General motion: F by the normalised eight-point method on points and noise-weighted affinities, E by projection.

Reference: R. Hartley, "In defense of the eight-point algorithm" (1997); L. Hajder, "Affine Correspondences in Stereo
Vision", F from points and affinities: one row per point, two per affinity.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rigkit.core.arrays import Mat3
from rigkit.core.matches import Matches
from rigkit.relative_pose.solvers.eight_point import essential_nearest, linear_epipolar, normalised
from rigkit.relative_pose.solvers.estimate import EpipolarEstimate, check_baseline, check_count, finish, reweighted
from rigkit.relative_pose.solvers.planar_ambiguity import refuse_planar_ambiguity
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
        rows, T1, T2 = normalised(matches)

        def linear(row_weights: RowWeights) -> Mat3:
            check_count(matches, row_weights, 8, "general epipolar geometry")
            return np.asarray(T2.T @ linear_epipolar(rows, row_weights) @ T1)

        matrix, used = reweighted(matches, weights, linear)
        refuse_planar_ambiguity(matches, used)
        return finish(matches, essential_nearest(matrix), matrix, used)
