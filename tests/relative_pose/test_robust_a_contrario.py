"""Agreement by chance: the criterion against counting, and in both directions."""

from __future__ import annotations

from dataclasses import replace
from math import comb, log

import numpy as np
import pytest
from helpers.epipolar_scenes import pair

from rigkit.geometry.sampson import sampson_of_matches
from rigkit.relative_pose.robust import log_false_alarms
from rigkit.relative_pose.solvers.pose import essential_from_pose

GATE = 3.3
ALL = np.ones(80, dtype=bool)


def fits(m, pose):
    E21 = essential_from_pose(pose)
    r = sampson_of_matches(E21, m, in_sigmas=True)
    return np.abs(r) < GATE


def test_right_matches_are_no_chance_and_wrong_ones_are(rng):
    m, pose, _ = pair(rng, 80, noise_px=0.5)
    assert log_false_alarms(m, pose, fits(m, pose), ALL, 5, GATE) < -100.0
    order = rng.permutation(80)
    wrong = replace(m, pixels2=m.pixels2[order], rays2=m.rays2[order], jacobians2=m.jacobians2[order])
    # Those few that fit the pose by chance, and the five that any sample fits.
    inliers = fits(wrong, pose) | (np.arange(80) < 5)
    assert log_false_alarms(wrong, pose, inliers, ALL, 5, GATE) > 0.0


def test_fewer_matches_than_a_pose_needs_say_nothing(rng):
    m, pose, _ = pair(rng, 80, noise_px=0.5)
    assert log_false_alarms(m, pose, np.arange(80) < 3, ALL, 5, GATE) == np.inf


def test_it_is_the_binomial_bound(rng):
    """The chance of a fit, measured over all wrong partners, is the share of all pairs of points that fit."""
    m, pose, _ = pair(rng, 80, noise_px=0.5)
    inliers = fits(m, pose)
    share = []
    for shift in range(1, 80):
        order = np.roll(np.arange(80), shift)
        share.append(
            fits(replace(m, pixels2=m.pixels2[order], rays2=m.rays2[order], jacobians2=m.jacobians2[order]), pose)
        )
    k, p = int(inliers.sum()), float(np.mean(share))
    expected = log(80) + log(comb(80, k)) + log(comb(k, 5)) + (k - 5) * log(p)
    found = log_false_alarms(m, pose, inliers, ALL, 5, GATE)
    # Half of the partners are tried: p is known to about 10 %.
    assert found == pytest.approx(expected, abs=0.15 * k)


def test_affinities_that_wrong_matches_fail_are_evidence(rng):
    m, pose, _ = pair(rng, 80, noise_px=0.5)
    order = np.r_[np.arange(30), 30 + rng.permutation(50)]
    mixed = replace(m, pixels2=m.pixels2[order], rays2=m.rays2[order], jacobians2=m.jacobians2[order])
    inliers = fits(mixed, pose)
    blind = log_false_alarms(mixed, pose, inliers, ALL, 5, GATE)
    seeing = log_false_alarms(mixed, pose, inliers, inliers, 5, GATE)
    assert seeing < blind - 20.0
