"""Evidence for pose types on scenes whose type is known."""

from __future__ import annotations

import re

import numpy as np
import pytest
from helpers.epipolar_scenes import board_pair, pair

from rigkit.core.errors import DegenerateError, InputError
from rigkit.core.posetype import PoseType
from rigkit.geometry.rigid3 import Rigid3
from rigkit.geometry.rotation import exp_so3
from rigkit.relative_pose.refinement.select import pose_type_evidence

POSES = {
    "general": Rigid3(exp_so3([0.05, 0.2, 0.03]), [-290.0, 30.0, 70.0]),
    "planar": Rigid3(exp_so3([0.0, 0.1, 0.0]), [-290.0, 0.0, -70.0]),
    "standard": Rigid3(np.eye(3), [-300.0, 0.0, 0.0]),
    "forward": Rigid3(np.eye(3), [0.0, 0.0, -200.0]),
}


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
