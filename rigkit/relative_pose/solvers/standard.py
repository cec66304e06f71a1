"""Standard stereo with unknown vertical intrinsics: the affine relation between corresponding rows of the two images.

F = [[0, 0, 0], [0, 0, a], [0, b, c]]: the vertical coordinates of the normalised images obey a y2 + b y1 + c = 0. The
rows on (a, b, c) are [y2, y1, 1] of a point and [a3, 0, 0], [a4, 1, 0] of an affinity A = [[a1, a2], [a3, a4]]: two
degrees of freedom. For any central camera the affinity's rows are [g2 A, g1, 0] with g = d y / d pixel. With known
intrinsics nothing is left to estimate: `family.STANDARD`.

Reference: L. Hajder, "Affine Correspondences in Stereo Vision", standard stereo.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rigkit.core.arrays import BoolArray, FloatArray, Mat3, RayJacobians, Rays
from rigkit.core.errors import DegenerateError
from rigkit.core.matches import Matches
from rigkit.relative_pose.solvers.estimate import EpipolarEstimate, check_baseline, check_count, finish, reweighted
from rigkit.relative_pose.solvers.pose import essential_nearest
from rigkit.relative_pose.solvers.rows import right_singular
from rigkit.relative_pose.solvers.weights import RowWeights, WeightRule

ONE_ROW_RAD = 1e-12
"""A smaller standard deviation of the vertical coordinates is rounding."""
UNDETERMINED = 1e-12
"""A smaller ratio of the second singular value to the first is rounding."""
MIN_AHEAD = 0.05
"""Smallest z of a unit ray that is used: rays 87 degrees and more off the axis are not in a perspective image."""


@dataclass(frozen=True, slots=True)
class RowsSolver:
    """E21 of two images whose epipolar lines are rows, with an unknown affine relation between corresponding rows."""

    degrees_of_freedom: int = 2

    def solve(self, matches: Matches, weights: WeightRule | None = None) -> EpipolarEstimate:
        """Return the epipolar geometry of standard stereo with free rows; see FundamentalSolver.

        F21 has the estimated relation of the rows; E21, which cannot represent other intrinsics, is the nearest one.

        Raises DegenerateError if all points lie on one row.
        """
        rows = _Rows.of(matches)

        def best(row_weights: RowWeights) -> Mat3:
            check_count(matches, row_weights, self.degrees_of_freedom, "standard stereo with free rows")
            return rows.relation(row_weights)

        check_baseline(matches)
        on_rays, used = reweighted(matches, weights, best)
        return finish(matches, essential_nearest(on_rays), on_rays, used)


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class _Rows:
    """Vertical coordinates (N,) of normalised images and their derivatives.

    Attributes
    ----------
    y1, y2 : vertical coordinates y / z, valid where `ahead`.
    sigma : (N,) standard deviation of y2 - y1.
    by1, by2 : (N, 2) derivatives of y1, and of y2 through the affinity, by the pixel of image 1; NaN without affinity.
    across : (N,) |d y2 / d pixel 2|.
    """

    y1: FloatArray
    y2: FloatArray
    ahead: BoolArray
    sigma: FloatArray
    by1: FloatArray
    by2: FloatArray
    across: FloatArray

    @classmethod
    def of(cls, m: Matches) -> _Rows:
        y1, g1, ahead1 = _vertical(m.rays1, m.jacobians1)
        y2, g2, ahead2 = _vertical(m.rays2, m.jacobians2)
        size1, size2 = (np.linalg.norm(g, axis=1) for g in (g1, g2))
        sigma = np.hypot(m.sigma1_px * size1, m.sigma2_px * size2)
        by2 = np.full((len(m), 2), np.nan) if m.A21 is None else np.einsum("ni,nij->nj", g2, m.A21)
        return cls(y1=y1, y2=y2, ahead=ahead1 & ahead2, sigma=sigma, by1=g1, by2=by2, across=size2)

    def relation(self, weights: RowWeights) -> Mat3:
        """Return E (3, 3) on rays of the least squares (a, b, c); raises DegenerateError if it is not determined."""
        point = self.ahead & (weights.points > 0.0)
        affine = self.ahead & (weights.affinities > 0.0)
        if not (point.any() or affine.any()):
            raise DegenerateError(
                "the relation between the images' rows is not determined: no point lies ahead; check the pose type"
            )
        some = point if point.any() else affine
        shift1, shift2 = float(self.y1[some].mean()), float(self.y2[some].mean())
        spread = float(np.std(self.y1[some]))
        scale = 1.0 / spread if spread > ONE_ROW_RAD else 1.0 / float(self.across[some].mean())
        # Without sigma_A: equal weights of points' rows (in units of the spread) and affinities' rows (per pixel 1).
        known = bool(np.isfinite(weights.sigma_A[affine]).all())
        pixel = 1.0 / float(np.linalg.norm(self.by1[some], axis=1).mean())
        noise = self.sigma[point] * scale if known else np.ones(int(point.sum()))
        noise_A = weights.sigma_A[affine] * self.across[affine] * pixel if known else np.ones(int(affine.sum()))
        ones = np.ones(int(point.sum()))
        of_points = np.stack([(self.y2 - shift2)[point] * scale, (self.y1 - shift1)[point] * scale, ones], axis=1)
        of_affinities = np.zeros((int(affine.sum()), 2, 3))
        of_affinities[..., 0], of_affinities[..., 1] = self.by2[affine] * pixel, self.by1[affine] * pixel
        weighted = (of_affinities / noise_A[:, None, None]).reshape(-1, 3)
        s, vt = right_singular(np.concatenate([of_points / noise[:, None], weighted]))
        if s[1] < UNDETERMINED * s[0]:
            raise DegenerateError("the relation between the images' rows is not determined: all points lie on one row")
        a, b, c = vt[2] * [scale, scale, 1.0]
        return np.array([[0.0, 0.0, 0.0], [0.0, 0.0, a], [0.0, b, c - a * shift2 - b * shift1]])


def _vertical(rays: Rays, jacobians: RayJacobians) -> tuple[FloatArray, FloatArray, BoolArray]:
    """Return y / z (N,) of rays, its derivative (N, 2) by the pixel, and which are valid."""
    ahead = rays[:, 2] > MIN_AHEAD
    z = np.where(ahead, rays[:, 2], 1.0)
    y = rays[:, 1] / z
    return y, (jacobians[:, 1] - y[:, None] * jacobians[:, 2]) / z[:, None], np.asarray(ahead)
