"""Standard stereo of perspective views whose vertical intrinsics are not known: which rows of both images are one row.

F = [[0, 0, 0], [0, 0, a], [0, b, c]] is estimated from the rows [v2, v1, 1] of points and [a3, 0, 0], [a4, 1, 0] of
affinities (A = [[a1, a2], [a3, a4]]): two degrees of freedom. Where the cameras are known nothing is left to estimate:
`fixed.FixedSolver`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rigkit.core.arrays import FloatArray, Mat3
from rigkit.core.errors import DegenerateError, InputError
from rigkit.core.matches import Matches
from rigkit.relative_pose.solvers.eight_point import essential_nearest
from rigkit.relative_pose.solvers.estimate import EpipolarEstimate, check_baseline, check_count, finish, reweighted
from rigkit.relative_pose.solvers.rows import right_singular
from rigkit.relative_pose.solvers.weights import RowWeights, WeightRule

__all__ = ["RowsSolver"]

ONE_ROW_PX = 1e-9
"""Rows that scatter by less are one row, and its rounding."""
UNDETERMINED = 1e-12
"""Second singular value over the first: what is below is rounding."""


@dataclass(frozen=True, slots=True)
class RowsSolver:
    """F21 of two images whose rows are parallel, the second's an affine function of the first's."""

    degrees_of_freedom: int = 2

    def solve(self, matches: Matches, weights: WeightRule | RowWeights | None = None) -> EpipolarEstimate:
        """Return the epipolar geometry of standard stereo with free rows; see FundamentalSolver.

        InputError where the pixels are not those of perspective views.
        """
        if matches.K1 is None or matches.K2 is None:
            raise InputError("standard stereo with free rows needs perspective views; rectify the images first")
        K1, K2 = matches.K1, matches.K2

        def best(row_weights: RowWeights) -> Mat3:
            check_count(matches, row_weights, self.degrees_of_freedom, "standard stereo with free rows")
            return np.asarray(K2.T @ _relation(matches, row_weights) @ K1)

        check_baseline(matches)
        on_rays, used = reweighted(matches, weights, best)
        return finish(matches, essential_nearest(on_rays), on_rays, used)


def _relation(matches: Matches, weights: RowWeights) -> Mat3:
    v1, v2 = matches.pixels1[:, 1], matches.pixels2[:, 1]
    shift1, shift2 = v1.mean(), v2.mean()
    spread = float(np.std(v1))
    scale = 1.0 / spread if spread > ONE_ROW_PX else 1.0
    # Residuals are differences of rows times the scale: one over their noise. An affinity's second row has sigma_A.
    known = bool(np.isfinite(weights.sigma_A[weights.affinities > 0.0]).all())
    noise = np.hypot(matches.sigma1_px, matches.sigma2_px) * scale if known else np.ones(len(v1))
    system: FloatArray = np.stack([(v2 - shift2) * scale, (v1 - shift1) * scale, np.ones(len(v1))], axis=1)
    system = system / noise[:, None]
    if matches.A21 is not None:
        used = weights.affinities > 0.0
        sigma = weights.sigma_A[used] if known else np.ones(int(used.sum()))
        a3, a4 = matches.A21[used, 1, 0] / sigma, matches.A21[used, 1, 1] / sigma
        zero = np.zeros_like(a3)
        system = np.concatenate([system, np.stack([a3, zero, zero], axis=1), np.stack([a4, 1.0 / sigma, zero], axis=1)])
    s, vt = right_singular(system)
    if s[1] < UNDETERMINED * s[0]:
        raise DegenerateError("the relation between the images' rows is not determined: all points lie on one row")
    a, b, c = vt[2] * [scale, scale, 1.0]
    return np.array([[0.0, 0.0, 0.0], [0.0, 0.0, a], [0.0, b, c - a * shift2 - b * shift1]])
