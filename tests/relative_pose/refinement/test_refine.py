"""Maximum likelihood refinement: derivatives, bias, covariance against Monte Carlo, constraints, priors, outliers."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from helpers.epipolar_scenes import (
    FISHEYE,
    REGULAR,
    board_pair,
    joined,
    pair,
    pictures,
    plane_in_sight,
    pose_errors_deg,
    pose_of,
)

from rigkit.core.errors import DegenerateError, InputError
from rigkit.core.matches import Matches
from rigkit.geometry.rigid3 import Rigid3
from rigkit.geometry.rotation import exp_so3, log_so3, unit
from rigkit.relative_pose.refinement.pose_problem import cauchy_weights
from rigkit.relative_pose.refinement.refine import estimate_pose, project_to_type, refine_pose
from rigkit.relative_pose.refinement.residuals import affinity_terms, level_terms, point_terms
from rigkit.relative_pose.solvers.pose import translation_basis

JACOBIAN_ABS = 1e-4
"""Of the largest entry: the derivative of the reprojection distance neglects second-order terms of the noise."""
COVARIANCE_REL = 0.15
"""Standard deviations, predicted against Monte Carlo: 160 runs know one to 5.6 %."""


def test_the_rule_auto_takes_how_sure_affinities_are_from_themselves(rng):
    m, _, _ = pair(rng, 60, noise_px=1.0, sigma_A=0.002)
    declared = [replace(m, sigma_A=np.full(len(m), sigma)) for sigma in (0.002, 1.0)]
    one, two = (estimate_pose(matches, weights="auto") for matches in declared)
    assert np.allclose(two.cam2_from_cam1.matrix(), one.cam2_from_cam1.matrix(), atol=1e-9)
    assert np.allclose(two.covariance, one.covariance, rtol=1e-6)
    # As sure as they are: told so, about the same comes out, and told another number, another one.
    so, less = (np.sqrt(np.trace(estimate_pose(matches).covariance)) for matches in declared)
    assert np.sqrt(np.trace(one.covariance)) == pytest.approx(so, rel=0.2) and less > 1.2 * so


@pytest.mark.parametrize("camera", [REGULAR, FISHEYE], ids=["pinhole", "fisheye"])
def test_jacobians_are_derivatives(rng, camera):
    m, pose, _ = pair(rng, 20, noise_px=0.1, sigma_A=0.01, camera=camera)
    R, t = pose.rotation, unit(pose.translation_mm)
    basis = translation_basis(t)

    def terms(step):
        R2, t2 = exp_so3(step[:3]) @ R, t + step[3:] @ basis
        r, _ = point_terms(m, R2, t2, basis)
        a, _, _ = affinity_terms(m, R2, t2, basis)
        level = [level_terms(kind, R2, t2, basis)[0] for kind in ("planar",)]
        return r, a.ravel(), np.concatenate(level)

    h = 1e-6
    numeric = [
        np.stack([(p - q) / (2 * h) for p, q in zip(parts, other, strict=True)], axis=1)
        for parts, other in (
            ([terms(h * e)[k] for e in np.eye(5)], [terms(-h * e)[k] for e in np.eye(5)]) for k in range(3)
        )
    ]
    exact = (
        point_terms(m, R, t, basis)[1],
        affinity_terms(m, R, t, basis)[1].reshape(-1, 5),
        level_terms("planar", R, t, basis)[1],
    )
    for a, b, tolerance in zip(exact, numeric, (1e-2, JACOBIAN_ABS, JACOBIAN_ABS), strict=True):
        assert np.abs(a - b).max() < tolerance * np.abs(b).max()


@pytest.mark.parametrize("kind", ["general", "planar", "standard", "forward"])
@pytest.mark.parametrize("camera", [REGULAR, FISHEYE], ids=["pinhole", "fisheye"])
def test_exact_matches_give_the_exact_pose(rng, kind, camera):
    m, pose, _ = pair(rng, 25, kind, sigma_A=0.0, camera=camera)
    refined = estimate_pose(m, kind)
    assert max(pose_errors_deg(refined.cam2_from_cam1, pose)) < 1e-6
    assert refined.converged
    assert refined.sampson_rms_px < 1e-7
    rank = {"general": 5, "planar": 2}.get(kind, 0)
    assert np.linalg.matrix_rank(refined.covariance, tol=1e-30, hermitian=True) == rank


@pytest.mark.parametrize(("kind", "camera"), [("general", REGULAR), ("general", FISHEYE), ("planar", REGULAR)])
@pytest.mark.parametrize("with_affinities", [False, True])
def test_predicted_covariance_and_no_bias(rng, kind, camera, with_affinities):
    """Monte Carlo over the noise of one scene, 0.3 px; the mean error is within its own standard error."""
    exact, pose, _ = pair(rng, 40, kind, sigma_A=0.0, camera=camera)
    sigma_px, sigma_A, runs = 0.3, 0.02, 160
    errors, predicted, factor = [], [], []
    for _ in range(runs):
        noisy = Matches.from_cameras(
            camera,
            camera,
            exact.pixels1 + rng.normal(size=(40, 2)) * sigma_px,
            exact.pixels2 + rng.normal(size=(40, 2)) * sigma_px,
            sigma1_px=np.full(40, sigma_px),
            sigma2_px=np.full(40, sigma_px),
            A21=exact.A21 + rng.normal(size=(40, 2, 2)) * sigma_A if with_affinities else None,
            sigma_A=np.full(40, sigma_A) if with_affinities else None,
        )
        refined = refine_pose(noisy, pose, kind)
        found = refined.cam2_from_cam1
        errors.append(
            np.concatenate(
                [log_so3(found.rotation @ pose.rotation.T), found.translation_mm - unit(pose.translation_mm)]
            )
        )
        predicted.append(refined.covariance)
        factor.append(refined.variance_factor)
    off, expected = np.array(errors), np.mean(predicted, axis=0)
    free = np.diag(expected) > 1e-6 * np.trace(expected)
    ratio = np.sqrt(np.mean(off**2, axis=0)[free] / np.diag(expected)[free])
    assert np.abs(ratio - 1.0).max() < COVARIANCE_REL
    standard_error = np.sqrt(np.diag(expected)[free] / runs)
    assert np.abs(off.mean(axis=0)[free] / standard_error).max() < 4.0
    assert np.mean(factor) == pytest.approx(1.0, abs=0.05)


@pytest.mark.parametrize("noise_px", [0.03, 1.0])
def test_noise_scales_the_error_in_proportion(rng, noise_px):
    """From 0.03 to 1 px the variance factor stays 1: no bias that would grow with the noise."""
    factors = []
    for _ in range(30):
        m, pose, _ = pair(rng, 60, noise_px=noise_px)
        factors.append(refine_pose(m, pose).variance_factor)
    # 30 runs of 55 degrees of freedom: 3.5 % standard error.
    assert np.mean(factors) == pytest.approx(1.0, abs=0.14)


def test_constraints_hold_exactly(rng):
    m, _, _ = pair(rng, 40, "planar", noise_px=0.5)
    pose = estimate_pose(m, "planar").cam2_from_cam1
    assert np.abs(pose.rotation[:, 1] - [0, 1, 0]).max() < 1e-12
    assert abs(pose.translation_mm[1]) < 1e-12
    start = Rigid3(exp_so3([0.01, 0.1, -0.02]), [-1.0, 0.05, 0.1])
    for kind, t in (("standard", [-1.0, 0, 0]), ("forward", [0, 0, 1.0])):
        R, direction = project_to_type(start, kind)
        assert np.array_equal(R, np.eye(3))
        assert np.allclose(direction, t)
    with pytest.raises(DegenerateError, match="allows"):
        project_to_type(Rigid3(np.eye(3), [0.0, 0.0, 1.0]), "standard")


def test_soft_prior_goes_from_constraint_to_nothing(rng):
    """A tiny level sigma is the exact type, a huge one the general pose."""
    tilt = Rigid3(exp_so3([0.003, 0.1, -0.002]), [-299.0, 1.0, 20.0])
    m, _ = board_pair(rng, tilt, 0.1)
    hard = estimate_pose(m, "planar").cam2_from_cam1
    general = estimate_pose(m, "general").cam2_from_cam1
    tight = estimate_pose(m, "planar", 1e-9).cam2_from_cam1
    loose = estimate_pose(m, "planar", 10.0).cam2_from_cam1
    assert max(pose_errors_deg(tight, hard)) < 1e-3
    assert max(pose_errors_deg(loose, general)) < 1e-3
    assert max(pose_errors_deg(hard, general)) > 0.05


def test_cauchy_weights_carry_a_few_outliers(rng):
    m, pose, _ = pair(rng, 60, noise_px=0.3)
    q2 = np.array(m.pixels2)
    q2[:5] += rng.uniform(20, 60, (5, 2))
    wild = Matches.from_cameras(REGULAR, REGULAR, m.pixels1, q2, sigma1_px=m.sigma1_px, sigma2_px=m.sigma2_px)
    plain = pose_errors_deg(refine_pose(wild, pose).cam2_from_cam1, pose)
    robust = refine_pose(wild, pose, robust=cauchy_weights)
    assert max(pose_errors_deg(robust.cam2_from_cam1, pose)) < 0.25 * max(plain)
    assert robust.weights[:5].max() < 0.2
    assert np.median(robust.weights[5:]) > 0.8


def test_no_baseline_and_nonsense_are_refused(rng):
    m, pose, _ = pair(rng, 20)
    with pytest.raises(DegenerateError, match="no baseline"):
        refine_pose(m, Rigid3(np.eye(3), np.zeros(3)))
    with pytest.raises(InputError, match="cannot be refined"):
        refine_pose(m, pose, "auto")
    with pytest.raises(InputError, match="positive"):
        refine_pose(m, pose, "planar", 0.0)
    with pytest.raises(InputError, match="residuals for"):
        refine_pose(m.select(np.arange(3)), pose)


def test_planar_ambiguity_gives_both_poses_or_says_so(rng):
    """The true pose is among the homography's; a single board in general position is refused where both fit."""
    from rigkit.relative_pose.solvers.planar_ambiguity import ambiguous_poses

    refused = solved = 0
    for _ in range(12):
        pose = pose_of("general", rng)
        m, _ = board_pair(rng, pose, 0.0)
        for b in range(3):
            one = m.select(m.board_index == b)
            if len(one) < 20:
                continue
            found = ambiguous_poses(replace(one, sigma1_px=np.full(len(one), 0.1), sigma2_px=np.full(len(one), 0.1)))
            assert min(max(pose_errors_deg(p, pose)) for p in found) < 1e-4
            try:
                end = estimate_pose(replace(one, sigma1_px=np.full(len(one), 0.1), sigma2_px=np.full(len(one), 0.1)))
            except DegenerateError as error:
                assert "one plane" in str(error)
                refused += 1
                continue
            assert max(pose_errors_deg(end.cam2_from_cam1, pose)) < 1e-3
            solved += 1
    assert refused > 0
    assert solved > 0
    three, _ = board_pair(rng, Rigid3(exp_so3([0.05, 0.2, 0.03]), [-290.0, 30.0, 70.0]), 0.1)
    assert ambiguous_poses(three) == ()


@pytest.mark.parametrize("noise_px", [0.05, 0.3])
def test_noise_does_not_choose_between_the_poses_of_a_plane(rng, noise_px):
    # Each pose sees another part of the noise: their costs differ by 20 and more, which says nothing.
    solved = 0
    for _ in range(40):
        m, pose = plane_in_sight(rng, noise_px)
        try:
            found = estimate_pose(m).cam2_from_cam1
        except DegenerateError as error:
            assert "one plane" in str(error)
            continue
        # The direction is known to about noise over parallax, 0.3 px of 250.
        assert max(pose_errors_deg(found, pose)) < 2.0
        solved += 1
    # Often only one of the two poses has all of the plane in front of both cameras.
    assert solved > 10


def test_points_off_the_plane_choose_between_its_poses(rng):
    for _ in range(20):
        m, pose = plane_in_sight(rng)
        others, _, _ = pair(rng, 30, pose=pose, noise_px=0.3)
        assert max(pose_errors_deg(estimate_pose(joined(m, others)).cam2_from_cam1, pose)) < 1.0


def test_a_short_baseline_is_no_reason_to_find_two_poses(rng):
    # Nearly a plane at infinity: one of its poses can be refined into the true one mirrored, all points behind.
    for _ in range(25):
        X = rng.uniform([-500.0, -400.0, 800.0], [500.0, 400.0, 2000.0], (200, 3))
        pose = Rigid3(exp_so3([0.02, 0.1, 0.03]), unit(rng.normal(size=3) * [1.0, 1.0, 0.5]) * 6.0)
        # A parallax of 6 px, known to 0.03: the direction to a few degrees.
        assert max(pose_errors_deg(estimate_pose(pictures(rng, X, pose)).cam2_from_cam1, pose)) < 20.0


@pytest.mark.parametrize("turn", [0.0, 0.1])
@pytest.mark.parametrize("kind", ["general", "planar", "standard", "forward"])
def test_a_pose_without_a_baseline_is_refused(rng, turn, kind):
    X = rng.uniform([-500.0, -400.0, 800.0], [500.0, 400.0, 2000.0], (150, 3))
    with pytest.raises(DegenerateError, match="no baseline"):
        estimate_pose(pictures(rng, X, Rigid3(exp_so3([0.02, turn, 0.03]), np.zeros(3))), kind)


FORWARD = Rigid3(exp_so3([0.01, 0.02, -0.03]), [5.0, 3.0, -200.0])
"""The epipole is near the middle of both images."""


@pytest.mark.parametrize("sigma_A", [0.005, 0.05])
@pytest.mark.parametrize("camera", [REGULAR, FISHEYE], ids=["pinhole", "fisheye"])
def test_residuals_of_affinities_have_the_variance_one_near_the_epipole_too(rng, sigma_A, camera):
    # There the epipolar lines of noisy pixels lie anyhow, and the affinity's own noise is the lesser part.
    R, t = FORWARD.rotation, unit(FORWARD.translation_mm)
    m, _, _ = pair(rng, 3000, pose=FORWARD, noise_px=0.5, sigma_A=sigma_A, camera=camera)
    r, _, _ = affinity_terms(m, R, t, translation_basis(t))
    away = np.linalg.norm(m.pixels2 - camera.project(-t)[0], axis=1)
    for near, far in ((0.0, 60.0), (60.0, 150.0), (150.0, 400.0), (400.0, 2000.0)):
        within = (away >= near) & (away < far)
        # The mean of 2 n squares is known to sqrt(1 / n).
        assert np.mean(r[within] ** 2) == pytest.approx(1.0, abs=0.1 + 4.0 / np.sqrt(within.sum()))


def test_accurate_affinities_help_where_the_epipole_is_in_the_image(rng):
    errors = []
    for _ in range(30):
        m, _, _ = pair(rng, 100, pose=FORWARD, noise_px=0.5, sigma_A=0.005)
        ways = (m, replace(m, A21=None, sigma_A=None))
        errors.append([pose_errors_deg(refine_pose(way, FORWARD).cam2_from_cam1, FORWARD) for way in ways])
    both, points = np.sqrt(np.mean(np.square(errors), axis=0))
    assert (both < 0.9 * points).all()
