"""A-contrario test: do more matches fit a pose than by chance? Boards and facades partly fit many poses."""

from __future__ import annotations

from dataclasses import replace
from math import inf, lgamma

import numpy as np

from rigkit.core.arrays import BoolArray
from rigkit.core.matches import Matches
from rigkit.geometry.rigid3 import Rigid3
from rigkit.geometry.sampson import sampson_of_matches
from rigkit.relative_pose.solvers.pose import essential_from_pose

SHIFTS = 40
"""Random wrong partners tried per point, so that the probability of a chance fit is known to a few per cent."""


def log_false_alarms(
    matches: Matches, pose: Rigid3, inliers: BoolArray, affinity_fits: BoolArray, freedom: int, gate: float
) -> float:
    """Return the log number of false alarms: the expected number of poses with as many inliers among wrong matches.

    Infinite if there are fewer inliers than degrees of freedom.

    Parameters
    ----------
    matches : all N.
    pose : found by sampling; the length of its translation is ignored.
    inliers : (N,) matches that fit it, by point and by affinity.
    affinity_fits : (N,) whether the affinity fits; True without an affinity.
    freedom : degrees of freedom of the pose.
    gate : largest Sampson distance of a point that fits, in sigmas.

    Notes
    -----
    N C(N, k) C(k, freedom) p^(k - freedom) with k inliers (Moisan and Stival, "A probabilistic criterion to detect
    rigid point matches between two images and estimate the fundamental matrix"). The probability p that a wrong match
    fits is estimated from the points with wrong partners, and from the affinities of the points that do not fit.
    """
    n, k = len(matches), int(inliers.sum())
    if k < freedom:
        return inf
    fitting = total = 0
    for shift in range(1, min(n, SHIFTS + 1)):
        other = np.roll(np.arange(n), shift)
        wrong = replace(
            matches,
            pixels2=matches.pixels2[other],
            rays2=matches.rays2[other],
            jacobians2=matches.jacobians2[other],
            sigma2_px=matches.sigma2_px[other],
        )
        fitting += int(_fits(wrong, pose, gate).sum())
        total += n
    by_point = (fitting + 1.0) / (total + 1.0)
    outlying = ~_fits(matches, pose, gate)
    by_affinity = (affinity_fits[outlying].sum() + 1.0) / (outlying.sum() + 1.0)
    log_chance = float(np.log(by_point * by_affinity))
    return float(np.log(n)) + _log_choose(n, k) + _log_choose(k, freedom) + (k - freedom) * log_chance


def _fits(m: Matches, pose: Rigid3, gate: float) -> BoolArray:
    return np.asarray(np.abs(sampson_of_matches(essential_from_pose(pose), m, in_sigmas=True)) < gate)


def _log_choose(n: int, k: int) -> float:
    return lgamma(n + 1.0) - lgamma(k + 1.0) - lgamma(n - k + 1.0)
