"""Affinities help where there are few points, and never harm: medians over seeded scenes at 0.5 px.

Affinity noise 0.02 is that of a good estimator, 0.2 that of a poor one.
"""

from __future__ import annotations

import numpy as np
import pytest
from helpers.epipolar_scenes import pair, pose_errors_deg

from rigkit.errors import DegenerateError, RigkitError
from rigkit.fundamental.minimal import planar_from_two_rows
from rigkit.fundamental.pose import choose_pose
from rigkit.fundamental.refine import estimate_pose
from rigkit.fundamental.registry import fundamental_for
from rigkit.fundamental.rows import PLANAR_ENTRIES, point_rows

LOST = (180.0, 180.0)
"""A scene without an answer counts as the worst one."""


def errors(solve, pose):
    try:
        return pose_errors_deg(solve(), pose)
    except RigkitError:
        return LOST


def medians(rng, kind, count, sigma_A, scenes, rules, *, refine):
    rows = []
    for _ in range(scenes):
        m, pose, _ = pair(rng, count, kind, noise_px=0.5, sigma_A=sigma_A)

        def solve(rule, m=m):
            if refine:
                return estimate_pose(m, kind, weights=rule).cam2_from_cam1
            return choose_pose(fundamental_for(kind).solve(m, rule).E21, m.rays1, m.rays2, kind)

        rows.append([errors(lambda rule=rule: solve(rule), pose) for rule in rules])
    return np.median(rows, axis=0)


def test_eight_points_with_good_affinities_are_twice_as_good(rng):
    points, noise, auto = medians(rng, "general", 8, 0.02, 60, ("points", "noise", "auto"), refine=False)
    assert np.all(points > 2.0 * noise)
    assert np.all(points > 2.0 * auto)


def two_point_pose(m):
    """What two points alone can say: one of the two planar solutions through them, that with them in front."""
    rows = point_rows(m.rays1, m.rays2)[:, list(PLANAR_ENTRIES)]
    found = planar_from_two_rows(rows[None])[0]
    for E in found[np.isfinite(found).all(axis=(1, 2))]:
        try:
            return choose_pose(E, m.rays1, m.rays2, "planar")
        except RigkitError:
            continue
    raise DegenerateError("no planar pose through the two points")


def test_planar_motion_from_two_affine_correspondences_is_three_times_as_good(rng):
    rows = []
    for _ in range(60):
        m, pose, _ = pair(rng, 2, "planar", noise_px=0.5, sigma_A=0.02)
        alone = errors(lambda m=m: two_point_pose(m), pose)
        rows.append([alone, errors(lambda m=m: estimate_pose(m, "planar").cam2_from_cam1, pose)])
    points, both = np.median(rows, axis=0)
    assert np.all(points > 3.0 * both)


@pytest.mark.parametrize("count", [20, 100])
def test_equal_weights_harm_noise_weights_do_not(rng, count):
    points, noise, equal = medians(rng, "general", count, 0.1, 40, ("points", "noise", "equal"), refine=False)
    assert np.all(equal > 3.0 * points)
    # 40 scenes: a ratio of medians over the same scenes is known to about 10 %.
    assert np.all(noise < 1.25 * points)


@pytest.mark.slow
@pytest.mark.parametrize("sigma_A", [0.02, 0.05, 0.2])
@pytest.mark.parametrize("count", [8, 20, 60, 200])
def test_never_worse_than_points_alone(rng, count, sigma_A):
    points, noise, auto = medians(rng, "general", count, sigma_A, 200, ("points", "noise", "auto"), refine=True)
    # 200 scenes: 5 %.
    assert np.all(noise < 1.05 * points)
    assert np.all(auto < 1.05 * points)
