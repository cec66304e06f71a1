"""Standard stereo: no rotation, translation along x. With known cameras nothing is left to estimate but the scale.

Where the vertical intrinsics of perspective views are not known, F = [[0, 0, 0], [0, 0, a], [0, b, c]] is estimated
from the rows [v2, v1, 1] of points and [a3, 0, 0], [a4, 1, 0] of affinities: two degrees of freedom.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rigkit.arrays import FloatArray
from rigkit.errors import DegenerateError, InputError
from rigkit.fundamental.eight_point import essential_nearest
from rigkit.fundamental.estimate import EpipolarEstimate, check_baseline, finish
from rigkit.fundamental.rows import right_singular
from rigkit.fundamental.weights import RowWeights, WeightRule, assumed_sigma_A, noise_weights
from rigkit.geometry.rotation import skew
from rigkit.matches import Matches

__all__ = ["StandardSolver"]


@dataclass(frozen=True, slots=True)
class StandardSolver:
    """E21 = [(1, 0, 0)]x; with `free_rows` the relation between the two images' rows is estimated too."""

    free_rows: bool = False

    @property
    def degrees_of_freedom(self) -> int:
        return 2 if self.free_rows else 0

    def solve(self, matches: Matches, weights: WeightRule | RowWeights | None = None) -> EpipolarEstimate:
        """Return the epipolar geometry of standard stereo; see FundamentalSolver. The sign is left to cheirality."""
        check_baseline(matches)
        E21 = skew(np.array([1.0, 0.0, 0.0]))
        used = fixed_weights(matches, E21, weights)
        if not self.free_rows:
            return finish(matches, E21, E21, used)
        if matches.K1 is None or matches.K2 is None:
            raise InputError("standard stereo with free rows needs perspective views; rectify the images first")
        F21 = self._rows_relation(matches, used)
        on_rays = matches.K2.T @ F21 @ matches.K1
        return finish(matches, essential_nearest(on_rays), on_rays, used)

    @staticmethod
    def _rows_relation(matches: Matches, weights: RowWeights) -> FloatArray:
        v1, v2 = matches.pixels1[:, 1], matches.pixels2[:, 1]
        shift1, shift2 = v1.mean(), v2.mean()
        scale = 1.0 / max(float(np.std(v1)), 1e-12)
        rows = np.stack([(v2 - shift2) * scale, (v1 - shift1) * scale, np.ones(len(v1))], axis=1)
        # The residual is a row difference times the scale: one over its noise, and that of A's second row.
        noise = np.sqrt(matches.sigma1_px**2 + matches.sigma2_px**2) * scale
        system = rows / noise[:, None]
        if matches.A21 is not None:
            used = weights.affinities > 0.0
            a3, a4 = matches.A21[used, 1, 0], matches.A21[used, 1, 1]
            zero, one = np.zeros_like(a3), np.ones_like(a3)
            sigma = weights.sigma_A[used] if np.isfinite(weights.sigma_A[used]).all() else one
            system = np.concatenate(
                [
                    system,
                    np.stack([a3, zero, zero], axis=1) / sigma[:, None],
                    np.stack([a4, one, zero], axis=1) / sigma[:, None],
                ]
            )
        s, vt = right_singular(system)
        if s[1] < 1e-12 * s[0]:
            raise DegenerateError("the relation between the images' rows is not determined: all points lie on one row")
        a, b, c = vt[2] * [scale, scale, 1.0]
        F21 = np.zeros((3, 3))
        F21[1, 2], F21[2, 1], F21[2, 2] = a, b, c - a * shift2 - b * shift1
        return F21


def fixed_weights(matches: Matches, E21: FloatArray, weights: WeightRule | RowWeights | None) -> RowWeights:
    """Return the row weights that belong to a geometry known beforehand."""
    if isinstance(weights, RowWeights):
        return weights
    return noise_weights(matches, E21, assumed_sigma_A(matches, weights or "noise"))
