"""Affinities help where there are few points, and never harm: medians over seeded scenes at 0.5 px.

Affinity noise 0.02 is that of a good estimator, 0.2 that of a poor one.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from helpers.epipolar_scenes import pair, pose_errors_deg

from rigkit.affine.affinities import EpipolarNormals
from rigkit.affine.registry import affines_from_directions
from rigkit.core.errors import DegenerateError, RigkitError
from rigkit.core.matches import DirectionPairs
from rigkit.relative_pose.refinement.refine import estimate_pose
from rigkit.relative_pose.solvers.planar import planar_from_two_rows
from rigkit.relative_pose.solvers.pose import choose_pose
from rigkit.relative_pose.solvers.registry import fundamental_for
from rigkit.relative_pose.solvers.rows import PLANAR_ENTRIES, point_rows
from rigkit.relative_pose.solvers.weights import estimate_sigma_A

BOOTSTRAPS = 300
LOST = (180.0, 180.0)
"""A scene without an answer counts as the worst one."""


def errors(solve, pose):
    try:
        return pose_errors_deg(solve(), pose)
    except RigkitError:
        return LOST


def all_errors(rng, kind, count, sigma_A, scenes, rules, *, refine):
    """Errors (scenes, rules, 2) of rotation and direction in degrees, by several weight rules in the same scenes."""
    rows = []
    for _ in range(scenes):
        m, pose, _ = pair(rng, count, kind, noise_px=0.5, sigma_A=sigma_A)

        def solve(rule, m=m):
            if refine:
                return estimate_pose(m, kind, weights=rule).cam2_from_cam1
            return choose_pose(fundamental_for(kind).solve(m, rule).E21, m.rays1, m.rays2, kind)

        rows.append([errors(lambda rule=rule: solve(rule), pose) for rule in rules])
    return np.array(rows)


def medians(*args, **options):
    return np.median(all_errors(*args, **options), axis=0)


def ratio_of_medians(found, base, rng):
    """Return the ratio of the median errors, and its standard error by drawing scenes anew (bootstrap)."""
    draws = rng.integers(0, len(found), (BOOTSTRAPS, len(found)))
    spread = np.median(found[draws], axis=1) / np.median(base[draws], axis=1)
    return np.median(found, axis=0) / np.median(base, axis=0), np.std(spread, axis=0)


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


def check_never_worse(rng, count, sigma_A, scenes):
    """The medians' ratio is not above 1 by more than three of its standard errors."""
    found = all_errors(rng, "general", count, sigma_A, scenes, ("points", "noise", "auto"), refine=True)
    for rule in (1, 2):
        ratio, spread = ratio_of_medians(found[:, rule], found[:, 0], rng)
        assert np.all(ratio < 1.0 + 3.0 * spread), (ratio, spread)


@pytest.mark.parametrize(("count", "sigma_A"), [(20, 0.02), (60, 0.2)])
def test_never_worse_than_points_alone_in_some_scenes(rng, count, sigma_A):
    check_never_worse(rng, count, sigma_A, 30)


@pytest.mark.slow
@pytest.mark.parametrize("sigma_A", [0.02, 0.05, 0.2])
@pytest.mark.parametrize("count", [8, 20, 60, 200])
def test_never_worse_than_points_alone(rng, count, sigma_A):
    check_never_worse(rng, count, sigma_A, 200)


def test_affinities_from_the_epipolar_geometry_tell_nothing_about_it(rng):
    """F3UDIR's affinities fulfil the geometry that they were computed with, right or wrong: using them is circular."""
    m, pose, _ = pair(rng, 40, noise_px=0.5, sigma_A=0.0)
    wrong = fundamental_for("general").solve(m, "points").E21
    epipolar = EpipolarNormals.of_matches(m, wrong)
    angle = rng.uniform(0.0, np.pi, (40, 1)) + np.arange(3.0)
    d1 = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    assert m.A21 is not None
    directions = DirectionPairs(image1=d1, image2=d1 @ np.swapaxes(m.A21, 1, 2), valid=np.ones((40, 3), dtype=bool))
    computed = affines_from_directions(directions, "F3UDIR", epipolar=epipolar)
    circular = replace(m, A21=computed.A21, sigma_A=np.full(40, 1e-4))
    assert estimate_sigma_A(circular, wrong) < 1e-12
    # Exact affinities of the surface, believed as much, do tell.
    declared, again = (
        choose_pose(fundamental_for("general").solve(v).E21, m.rays1, m.rays2)
        for v in (replace(m, sigma_A=np.full(40, 1e-4)), circular)
    )
    before = choose_pose(wrong, m.rays1, m.rays2)
    assert max(pose_errors_deg(again, before)) < 0.02 * max(pose_errors_deg(before, pose))
    assert max(pose_errors_deg(declared, pose)) < 0.5 * max(pose_errors_deg(before, pose))
