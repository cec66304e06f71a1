"""Standard stereo and forward motion: no rotation, translation along x or z. With known cameras nothing is left to
estimate but the scale, and the sign is left to cheirality.

Reference: L. Hajder, "Affine Correspondences in Stereo Vision", standard stereo and forward motion. What the printed
forms leave open, other vertical intrinsics and a roll, `standard.RowsSolver` and `forward.ForwardRollSolver` estimate.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rigkit.core.matches import Matches
from rigkit.geometry.rotation import skew
from rigkit.relative_pose.solvers.estimate import EpipolarEstimate, check_baseline, finish, reweighted
from rigkit.relative_pose.solvers.weights import RowWeights, WeightRule


@dataclass(frozen=True, slots=True)
class FixedSolver:
    """E21 = [t]x of a known direction; forward, in pixels, the skew matrix of the epipole, the principal point."""

    direction: tuple[float, float, float]
    degrees_of_freedom: int = 0

    def solve(self, matches: Matches, weights: WeightRule | RowWeights | None = None) -> EpipolarEstimate:
        """Return the known epipolar geometry, with the weights that belong to it; see FundamentalSolver."""
        check_baseline(matches)
        E21, used = reweighted(matches, weights, lambda _: skew(np.array(self.direction)))
        return finish(matches, E21, E21, used)
