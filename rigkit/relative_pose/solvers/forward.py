"""Forward motion along the optical axis whose roll is not known: the epipoles are fixed, the turn about them is not.

With t = (0, 0, 1) and a rotation by psi about the same axis E = [t]x R has the four entries of its upper left block,
E = [[a, b, 0], [-b, a, 0], [0, 0, 0]] with a = -sin psi and b = -cos psi. The rows on (a, b) are linear in points and
affinities alike: one degree of freedom. Where no roll is left nothing is left to estimate: `fixed.FixedSolver`. Where
the epipole is free instead, E = [t]x: `translation.TranslationSolver`.

Reference: L. Hajder, "Affine Correspondences in Stereo Vision", forward motion, F = [e]x with the epipole e in the
principal point.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rigkit.core.arrays import FloatArray
from rigkit.core.errors import DegenerateError
from rigkit.core.matches import Matches
from rigkit.relative_pose.solvers.estimate import EpipolarEstimate, check_baseline, check_count, finish, reweighted
from rigkit.relative_pose.solvers.rows import affinity_rows, point_rows, right_singular
from rigkit.relative_pose.solvers.weights import RowWeights, WeightRule

BASIS = np.array([[1.0, 0, 0, 0, 1, 0, 0, 0, 0], [0, 1.0, 0, -1, 0, 0, 0, 0, 0]])
"""vec(E) = (a, b) BASIS, row-major."""
MIN_OFF_AXIS = 1e-12
"""Rows smaller than this, rays being of unit length, are rounding: the points lie on the axis."""


@dataclass(frozen=True, slots=True)
class ForwardRollSolver:
    """Translation along z, rotation about z by an unknown angle."""

    degrees_of_freedom: int = 1

    def solve(self, matches: Matches, weights: WeightRule | RowWeights | None = None) -> EpipolarEstimate:
        """Return the least squares E21 of forward motion with a free roll; see FundamentalSolver.

        Raises DegenerateError where all points lie on the axis.
        """
        m = matches
        points = point_rows(m.rays1, m.rays2) @ BASIS.T
        affinities = np.zeros((len(m), 2, 2))
        if m.A21 is not None:
            rows = affinity_rows(m.rays1, m.rays2, m.jacobians1, m.jacobians2, np.nan_to_num(m.A21))
            affinities = rows @ BASIS.T

        def best(row_weights: RowWeights) -> FloatArray:
            check_count(m, row_weights, self.degrees_of_freedom, "forward motion with a free roll")
            more = affinities * row_weights.affinities[:, None, None]
            system = np.concatenate([points * row_weights.points[:, None], more.reshape(-1, 2)])
            s, vt = right_singular(system)
            if s[0] < MIN_OFF_AXIS * np.abs(row_weights.points).max():
                raise DegenerateError(
                    "the roll is not determined: all points lie on the optical axis; take images with points all over"
                )
            return np.asarray((vt[-1] @ BASIS).reshape(3, 3))

        check_baseline(m)
        E21, used = reweighted(m, weights, best)
        return finish(m, E21, E21, used)
