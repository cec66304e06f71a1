"""Evidence for pose types on scenes whose type is known."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest
from helpers.epipolar_scenes import board_pair, pair
from scipy.stats import multivariate_normal

from rigkit.core.errors import DegenerateError, InputError
from rigkit.core.posetype import PoseType
from rigkit.geometry.rigid3 import Rigid3
from rigkit.geometry.rotation import exp_so3
from rigkit.relative_pose.refinement.refine import estimate_pose, refine_pose, variance_factor
from rigkit.relative_pose.refinement.select import (
    _log_evidence,
    level_parts,
    pose_type_evidence,
    type_deviation_rad,
)

POSES = {
    "general": Rigid3(exp_so3([0.05, 0.2, 0.03]), [-290.0, 30.0, 70.0]),
    "planar": Rigid3(exp_so3([0.0, 0.1, 0.0]), [-290.0, 0.0, -70.0]),
    "standard": Rigid3(np.eye(3), [-300.0, 0.0, 0.0]),
    "forward": Rigid3(np.eye(3), [0.0, 0.0, -200.0]),
}

EVIDENCE = 0.1
"""Of log evidences, whose differences of 1 mean nothing: lenses and poses are not quite linear."""


@pytest.mark.parametrize("kind", POSES)
@pytest.mark.parametrize("noise_px", [0.03, 0.5])
def test_the_true_type_is_chosen(rng, kind, noise_px):
    m, _ = board_pair(rng, POSES[kind], noise_px)
    evidence = pose_type_evidence(m)
    assert evidence.choice == kind
    assert evidence.types[0].probability > 0.9
    assert sum(entry.probability for entry in evidence.types) == pytest.approx(1.0)
    assert evidence.contradiction(kind) is None


@pytest.mark.parametrize("kind", ["planar", "standard", "forward"])
def test_a_level_that_is_slightly_off_is_no_contradiction(rng, kind):
    level = np.radians(0.2)
    wrong = 0
    for _ in range(8):
        off = exp_so3(rng.normal(size=3) * level)
        pose = Rigid3(off @ POSES[kind].rotation, POSES[kind].translation_mm)
        m, _ = board_pair(rng, pose, 0.1)
        evidence = pose_type_evidence(m, level)
        assert evidence.choice == kind
        wrong += evidence.contradiction(kind) is not None
    assert wrong == 0


def test_a_wrong_declaration_is_contradicted_with_the_figure(rng):
    pose = Rigid3(exp_so3([0.0, 0.0, np.radians(3.0)]), [-300.0, 0.0, 0.0])
    m, _ = board_pair(rng, pose, 0.1)
    evidence = pose_type_evidence(m)
    assert evidence.choice == PoseType.GENERAL
    printed = evidence.contradiction("standard")
    assert printed is not None
    assert re.search(r"(2\.9|3\.0)\d deg", printed)
    assert "support 'general'" in printed
    assert evidence.contradiction("general") is None
    assert evidence.contradiction("auto") is None
    turned, _ = board_pair(rng, POSES["planar"], 0.1)
    assert pose_type_evidence(turned).contradiction("forward") is not None


def test_wrong_sigmas_are_corrected_by_the_fit(rng):
    """Sigmas of 1 px stated where the noise is 0.1: the deviation of 1.5 degrees is found all the same."""
    from dataclasses import replace

    pose = Rigid3(exp_so3([np.radians(1.5), 0.0, 0.0]), [-300.0, 0.0, 0.0])
    m, _ = board_pair(rng, pose, 0.1)
    one = np.ones(len(m))
    evidence = pose_type_evidence(replace(m, sigma1_px=one, sigma2_px=one))
    assert evidence.contradiction("standard") is not None


def test_no_baseline_is_an_error(rng):
    m, _, _ = pair(rng, 20)
    from dataclasses import replace

    same = replace(m, pixels2=m.pixels1, rays2=m.rays1, jacobians2=m.jacobians1)
    with pytest.raises((DegenerateError, InputError)):
        pose_type_evidence(same)
    with pytest.raises(InputError, match="positive"):
        pose_type_evidence(m, 0.0)


@pytest.mark.parametrize(
    ("kind", "turn", "direction", "expected"),
    [
        # About y the planar type may turn as it likes; about z by 0.05 it tilts, as the translation rises by 0.08.
        ("planar", exp_so3(np.array([0.0, 0.7, 0.0])), [0.6, 0.0, -0.8], 0.0),
        ("planar", exp_so3(np.array([0.0, 0.0, 0.05])) @ exp_so3(np.array([0.0, 0.7, 0.0])), [1.0, 0.0, 0.0], 0.05),
        ("planar", exp_so3(np.array([0.0, -0.4, 0.0])), [0.6 * np.cos(0.08), np.sin(0.08), -0.8 * np.cos(0.08)], 0.08),
        ("standard", exp_so3(np.array([0.0, 0.03, 0.04])), [-1.0, 0.0, 0.0], 0.05),
        ("standard", np.eye(3), [-np.cos(0.2), np.sin(0.2) * 0.6, np.sin(0.2) * 0.8], 0.2),
        ("forward", exp_so3(np.array([0.0, 0.1, 0.0])), [0.0, -np.sin(0.3), np.cos(0.3)], 0.3),
        ("general", exp_so3(np.array([0.3, 0.1, 0.0])), [0.0, 0.6, 0.8], 0.0),
    ],
)
def test_the_deviation_from_a_type_is_the_largest_angle(
    kind: str, turn: np.ndarray, direction: list[float], expected: float
) -> None:
    pose = Rigid3(turn, 300.0 * np.array(direction))
    assert type_deviation_rad(pose, PoseType(kind)) == pytest.approx(expected, abs=1e-7)


def test_the_variance_factor_is_that_of_the_residuals_where_there_are_many() -> None:
    assert variance_factor(9.0, 0) == variance_factor(9.0, -2) == 1.0
    assert variance_factor(2e6, 1_000_000) == pytest.approx(2.0, rel=1e-4)
    # One more residual of the stated size changes nothing.
    assert variance_factor(7.0, 7) == 1.0
    assert 1.0 < variance_factor(2.0 * 5, 5) < variance_factor(2.0 * 50, 50) < 2.0


@pytest.mark.parametrize("kind", [PoseType.PLANAR, PoseType.STANDARD, PoseType.FORWARD])
def test_the_evidence_is_that_of_gaussians(rng: np.random.Generator, kind: PoseType) -> None:
    """Of the general fit alone, whose likelihood is a Gaussian in five directions: times a Gaussian in the deviations
    of the type, its integral is the density N(deviations; 0, J C J^T + level^2 I), over the volume of what is free."""
    level, volume = np.radians(0.5), {PoseType.PLANAR: 4.0 * np.pi**2}.get(kind, 2.0)
    m, pose, _ = pair(rng, 60, str(kind), noise_px=0.3)
    tilted = Rigid3(exp_so3(np.radians([0.2, 0.0, -0.3])) @ pose.rotation, pose.translation_mm)
    m = replace(m, A21=None, sigma_A=None)
    general = estimate_pose(m, PoseType.GENERAL, None, weights="points")
    typed = refine_pose(m, tilted, kind, level)
    # Twice the stated sigmas, or four times their variance.
    wide = replace(m, sigma1_px=2.0 * m.sigma1_px, sigma2_px=2.0 * m.sigma2_px)
    general_wide = refine_pose(wide, general.cam2_from_cam1)
    for noise2, free, fit in ((1.0, general, typed), (4.0, general_wide, typed)):
        values, jacobian, covariance = level_parts(free, kind)
        spread = jacobian @ covariance @ jacobian.T + level**2 * np.eye(len(values))
        expected = multivariate_normal(np.zeros(len(values)), spread).logpdf(values)
        expected += -0.5 * free.cost + 2.5 * np.log(2.0 * np.pi) + 0.5 * np.linalg.slogdet(covariance)[1]
        assert _log_evidence(fit, kind, level, noise2) == pytest.approx(expected - np.log(volume), abs=EVIDENCE)
    own = level_parts(general, PoseType.GENERAL)[2]
    log = -0.5 * general.cost + 2.5 * np.log(2.0 * np.pi) + 0.5 * np.linalg.slogdet(own)[1]
    # Rotations have 8 pi^2, directions 4 pi.
    log -= np.log(8.0 * np.pi**2 * 4.0 * np.pi)
    assert _log_evidence(general, PoseType.GENERAL, level, 1.0) == pytest.approx(log, abs=1e-9)
