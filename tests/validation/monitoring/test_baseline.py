"""Changes since earlier pictures: errors that were already there are no change."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from helpers.calibration_scenes import lens, noisy_view
from helpers.monitoring_scenes import NOISE_PX, poses_held, scene_pixels

from rigkit.cameras.base import Camera
from rigkit.core.arrays import FloatArray
from rigkit.core.errors import InputError
from rigkit.geometry.rigid3 import Rigid3
from rigkit.geometry.rotation import exp_so3
from rigkit.report.pages.check_page import check_facts
from rigkit.validation.monitoring.baseline import check_since
from rigkit.validation.monitoring.epipolar import PairMatches, evidence_of_matches
from rigkit.validation.monitoring.evidence import FreshEvidence, FreshView, Monitored, evidence_of
from rigkit.validation.monitoring.verdict import ALARM_CHANCE, Look, evaluate_evidence

MOUNT = Rigid3(exp_so3(np.array([0.01, -0.08, 0.02])), [-120.0, 2.0, 3.0])
MATCH_NOISE_PX = 0.1
WRONG_DEG, TURN_DEG = 0.1, 0.05
BEFORE, FRESH = 9, 3
SEEDS = pytest.mark.parametrize("seed", [0, pytest.param(1, marks=pytest.mark.thorough)])


def _turned(pose: Rigid3, degrees: float) -> Rigid3:
    turn = exp_so3(np.radians([degrees, 0.0, 0.0]))
    return Rigid3(turn @ pose.rotation, turn @ pose.translation_mm)


def _file() -> Monitored:
    """A rig whose file is off: by 0.3 % of the left focus and a tenth of a degree, 15 and 87 of its sigmas."""
    camera = lens("wide")
    longer = camera.with_parameters(camera.parameters * np.where(np.arange(camera.parameters.size) < 2, 1.003, 1.0))
    sigmas = [0.1, 0.1, 0.1, 0.1, 2e-5, 2e-5, 2e-5, 2e-5]
    return Monitored(
        names=("left", "right"),
        cameras=(longer, camera),
        cam_from_rig=(Rigid3.identity(), _turned(MOUNT, WRONG_DEG)),
        covariance=np.diag([*sigmas, *sigmas, *[2e-5] * 3, *[0.01] * 3]) ** 2,
        sigma_px=NOISE_PX,
        freedom=20.0,
    )


def _scenes(pose: Rigid3, count: int, rng: np.random.Generator) -> Look:
    matches = [PairMatches(0, 1, *scene_pixels(pose, 300, MATCH_NOISE_PX, rng)) for _ in range(count)]
    return lambda now: evidence_of_matches(now, matches)


def _boards(camera: Camera, rng: np.random.Generator, which: slice) -> Look:
    poses = poses_held("reg", BEFORE + FRESH)[which]
    views = [FreshView(f"{k}", 0, noisy_view(camera, pose, f"{k}", rng, NOISE_PX)) for k, pose in enumerate(poses)]
    return lambda now: evidence_of(now, views)


@SEEDS
def test_a_wrong_rig_is_checked_for_changes_since_earlier_frames(seed: int) -> None:
    rng = np.random.default_rng(seed)
    before, same, moved = (_scenes(_turned(MOUNT, d), n, rng) for d, n in ((0.0, 2), (0.0, 1), (TURN_DEG, 1)))
    assert not evaluate_evidence(_file(), same).holds
    quiet, check = (check_since(_file(), before, look) for look in (same, moved))
    assert quiet.holds and quiet.baseline is not None and quiet.baseline.frames == 2
    assert quiet.baseline.rms_corrected_px < 0.5 * quiet.baseline.rms_px
    assert quiet.baseline.chance < ALARM_CHANCE
    asked = "make sure that they are of the same camera"
    assert any(asked in sentence for sentence in check_facts(quiet).sentences)
    assert check_facts(quiet).headline.startswith("Nothing changed since")
    assert not check.holds and check.change is not None and check.change.hypothesis.kind == "rotation"
    sigmas = check.change.sigmas
    assert check.change.amounts == pytest.approx([TURN_DEG, 0.0, 0.0], abs=4.0 * float(sigmas.max()))
    assert sigmas[0] < 0.1 * TURN_DEG
    assert check_facts(check).headline.startswith("Changed since (")


def test_pictures_of_before_of_two_moments_are_refused() -> None:
    """They disagree so much that nothing would pass for a change since."""
    rng = np.random.default_rng(3)
    camera, poses = lens("wide"), poses_held("wide", 3)
    rig = _file()

    def boards(shift: int) -> Look:
        views = []
        for k in range(2):
            views.append(FreshView(f"{k}", 0, noisy_view(rig.cameras[0], poses[k], f"{k}", rng, NOISE_PX)))
            held = rig.cam_from_rig[1] @ poses[k + shift]
            views.append(FreshView(f"{k}", 1, noisy_view(camera, held, f"{k}", rng, NOISE_PX)))
        return lambda now: evidence_of(now, views)

    assert check_since(rig, boards(0), boards(0)).holds
    with pytest.raises(InputError, match="the images of --before do not fit"):
        check_since(rig, boards(1), boards(0))


def _known(focus: float) -> tuple[Camera, Monitored]:
    """A lens, and its file, that is off by a focal length so many times as long."""
    camera = lens("reg")
    wrong = camera.with_parameters(camera.parameters * np.where(np.arange(camera.parameters.size) < 2, focus, 1.0))
    sigmas: FloatArray = np.array([0.3, 0.3, 0.3, 0.3, *[1e-3] * (camera.parameters.size - 4)])
    file = Monitored(
        names=("cam",),
        cameras=(wrong,),
        cam_from_rig=(Rigid3.identity(),),
        covariance=np.diag(sigmas**2),
        sigma_px=NOISE_PX,
        freedom=20.0,
    )
    return camera, file


@SEEDS
def test_a_wrong_lens_is_checked_for_changes_since_earlier_frames(seed: int) -> None:
    camera, file = _known(1.01)
    longer = camera.with_parameters(camera.parameters * np.where(np.arange(camera.parameters.size) < 2, 1.001, 1.0))
    fresh = slice(BEFORE, None)
    rng = np.random.default_rng(seed)
    before, same, moved = (
        _boards(c, rng, which) for c, which in ((camera, slice(BEFORE)), (camera, fresh), (longer, fresh))
    )
    assert not evaluate_evidence(file, same).holds
    assert check_since(file, before, same).holds
    check = check_since(file, before, moved)
    assert not check.holds and check.change is not None and check.change.hypothesis.kind == "focus"
    assert check.change.amounts == pytest.approx([0.1], abs=4.0 * float(check.change.sigmas[0]))


def test_frames_that_disagree_count_less() -> None:
    """Every frame errs as a whole: unchanged cameras must not alarm, as often as they say."""
    camera, file = _known(1.0)

    def erring(count: int, rng: np.random.Generator) -> Look:
        own = rng.standard_normal((count, camera.parameters.size)) * np.sqrt(np.diag(file.covariance))

        def look(now: Monitored) -> FreshEvidence:
            printed = reported(now)
            return replace(printed, score=printed.score + np.einsum("nij,nj->ni", printed.information, own))

        reported = _boards(camera, rng, slice(count))
        return look

    checks = [check_since(file, erring(4, rng), erring(4, rng)) for rng in map(np.random.default_rng, range(3))]
    assert all(check.holds for check in checks)
