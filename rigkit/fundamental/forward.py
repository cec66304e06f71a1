"""Forward motion: no rotation, translation along z. With known cameras nothing is left to estimate but the scale."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rigkit.fundamental.estimate import EpipolarEstimate, check_baseline, finish
from rigkit.fundamental.standard import fixed_weights
from rigkit.fundamental.weights import RowWeights, WeightRule
from rigkit.geometry.rotation import skew
from rigkit.matches import Matches

__all__ = ["ForwardSolver"]


@dataclass(frozen=True, slots=True)
class ForwardSolver:
    """E21 = [(0, 0, 1)]x: in pixels the skew matrix of the epipole, which is the principal point."""

    degrees_of_freedom: int = 0

    def solve(self, matches: Matches, weights: WeightRule | RowWeights | None = None) -> EpipolarEstimate:
        """Return the epipolar geometry of forward motion; see FundamentalSolver. The sign is left to cheirality."""
        check_baseline(matches)
        E21 = skew(np.array([0.0, 0.0, 1.0]))
        return finish(matches, E21, E21, fixed_weights(matches, E21, weights))
