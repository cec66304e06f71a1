"""Pure translation: no rotation, the direction of the translation unknown.

E = [t]x. Rows on t: a point gives f1 x f2, an affinity (B1 e_j) x f2 + f1 x (B2 A e_j), the derivative of the point's
row along the surface.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rigkit.core.arrays import FloatArray
from rigkit.core.errors import DegenerateError
from rigkit.core.matches import Matches
from rigkit.geometry.rotation import skew
from rigkit.relative_pose.solvers.estimate import EpipolarEstimate, check_baseline, check_count, finish, reweighted
from rigkit.relative_pose.solvers.rows import right_singular
from rigkit.relative_pose.solvers.weights import RowWeights, WeightRule


@dataclass(frozen=True, slots=True)
class TranslationSolver:
    """Two degrees of freedom, or one with `horizontal` (t_y = 0); two equations, or one."""

    horizontal: bool = False

    @property
    def degrees_of_freedom(self) -> int:
        return 1 if self.horizontal else 2

    def solve(self, matches: Matches, weights: WeightRule | RowWeights | None = None) -> EpipolarEstimate:
        """Return E21 = [t]x of the least squares direction t; see FundamentalSolver."""
        f1, f2 = matches.rays1, matches.rays2
        points = np.cross(f1, f2)
        affinities = np.zeros((len(matches), 2, 3))
        if matches.A21 is not None:
            d1 = np.swapaxes(matches.jacobians1, -1, -2)
            d2 = np.swapaxes(matches.jacobians2 @ np.nan_to_num(matches.A21), -1, -2)
            affinities = np.cross(d1, f2[:, None, :]) + np.cross(f1[:, None, :], d2)
        columns = np.array([0, 2]) if self.horizontal else np.arange(3)

        def best(row_weights: RowWeights) -> FloatArray:
            check_count(matches, row_weights, self.degrees_of_freedom, "pure translation")
            more = affinities * row_weights.affinities[:, None, None]
            rows = np.concatenate([points * row_weights.points[:, None], more.reshape(-1, 3)])[:, columns]
            s, vt = right_singular(rows)
            if s[len(columns) - 2] < 1e-12 * np.abs(row_weights.points).max():
                raise DegenerateError(
                    "the translation is not determined: the two images show the same rays; "
                    "take them from different places"
                )
            t = np.zeros(3)
            t[columns] = vt[-1]
            return skew(t)

        check_baseline(matches)
        E21, used = reweighted(matches, weights, best)
        return finish(matches, E21, E21, used)
