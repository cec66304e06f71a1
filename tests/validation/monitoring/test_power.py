"""Pictures planned for a check: the check has the promised power, and other pictures have less."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from helpers.calibration_scenes import BOARD, lens, noisy_view
from helpers.monitoring_scenes import known_rig

from rigkit.calibration.calibrate import calibrate
from rigkit.calibration.result import Calibration
from rigkit.core.arrays import FloatArray
from rigkit.core.detections import BoardView
from rigkit.core.reach import Reach
from rigkit.geometry.rigid3 import Rigid3
from rigkit.geometry.rotation import exp_so3
from rigkit.planning.candidates import board_in_view
from rigkit.planning.goal import projection_goal
from rigkit.planning.information import BoardPoses, CornerError, Knowledge
from rigkit.planning.plan import Plan, plan_views
from rigkit.report.pages.plan_page import plan_words
from rigkit.validation.monitoring.change_aim import informative_views
from rigkit.validation.monitoring.evidence import FreshEvidence, FreshView, Monitored, board_information
from rigkit.validation.monitoring.hypotheses import hypotheses_of
from rigkit.validation.monitoring.power import Power, powers_of
from rigkit.validation.monitoring.verdict import ALARM_CHANCE, CalibrationCheck, check_views
from rigkit.validation.monitoring.watch import monitored_camera

NOISE_PX = 0.05
FRESH = 3
PROMISED_WITHIN = 0.01
"""The chance promised is linearised at the calibration, and the board as stated; the check's at fresh corners."""


def _views(plan: Plan, rng: np.random.Generator) -> list[BoardView]:
    views = [noisy_view(lens("wide"), v.cam_from_board, f"{k}", rng, NOISE_PX) for k, v in enumerate(plan.views)]
    assert all(len(view.grid) == BOARD.corner_count for view in views)
    return views


@pytest.fixture(scope="module")
def calibration() -> Calibration:
    camera = lens("wide")
    known = Knowledge.guessed(camera, CornerError(NOISE_PX))
    plan = plan_views(known, [BOARD], projection_goal(camera), 14)
    views = _views(plan, np.random.default_rng(2))
    return calibrate(views, camera.size_px, model=camera.model, board="flat", folds=0)


def _checked(calibration: Calibration, plan: Plan, rng: np.random.Generator) -> CalibrationCheck:
    fresh = [FreshView(view.image, 0, view) for view in _views(plan, rng)]
    return check_views(monitored_camera(calibration, "cam"), fresh)


def test_pictures_find_what_was_promised_and_more_than_others(calibration: Calibration) -> None:
    plan, promised = informative_views(monitored_camera(calibration, "cam"), [BOARD], FRESH)
    printed = _checked(calibration, plan, np.random.default_rng(3)).powers
    assert [p.kind for p in printed] == [p.kind for p in promised] and len(printed) == 3
    for one, other in zip(printed, promised, strict=True):
        assert one.chance == pytest.approx(other.chance, abs=PROMISED_WITHIN)
    # What improves the calibration most is not what tells changes best: a focus is seen worst.
    improving = plan_views(Knowledge.of(calibration), [BOARD], projection_goal(calibration.camera), FRESH)
    worst = min(p.chance for p in _checked(calibration, improving, np.random.default_rng(3)).powers)
    assert 0.05 < worst < 0.9 * min(p.chance for p in promised)


def test_each_picture_raises_the_power(calibration: Calibration) -> None:
    plan, _ = informative_views(monitored_camera(calibration, "cam"), [BOARD], FRESH)
    errors = [plan.error, *(view.error for view in plan.views)]
    assert not np.isfinite(errors[0])
    assert all(after < before for before, after in pairwise(errors))


MOUNT = Rigid3(exp_so3(np.array([0.01, -0.3, 0.02])), [-180.0, 2.0, 30.0])
LENS_SIGMAS = [0.05, 0.05, 0.05, 0.05, 2e-5, 2e-5, 2e-5, 2e-5]


def _rig(mount: Rigid3) -> Monitored:
    return replace(known_rig(mount, LENS_SIGMAS, 1e-5, 50.0), sigma_px=NOISE_PX)


def _turn(powers: tuple[Power, ...]) -> float:
    return next(power.chance for power in powers if power.kind == "rotation")


def test_pictures_for_a_rig_find_what_was_promised_and_more_than_those_for_one_lens() -> None:
    rig, rng = _rig(MOUNT), np.random.default_rng(5)
    plan, promised = informative_views(rig, [BOARD], FRESH)
    assert [p.kind for p in promised] == ["focus"] * 2 + ["principal point"] * 2 + ["distortion"] * 2 + ["rotation"]
    # What tells of a mount is a board that both see.
    assert sum(len(view.seen_by) == 2 for view in plan.views) >= 2
    frames = []
    for k, view in enumerate(plan.views):
        rig_from_board = rig.cam_from_rig[rig.names.index(view.seen_by[0])].inverse() @ view.cam_from_board
        for name in view.seen_by:
            c = rig.names.index(name)
            own = noisy_view(rig.cameras[c], rig.cam_from_rig[c] @ rig_from_board, f"{k}", rng, NOISE_PX)
            assert len(own.grid) == BOARD.corner_count
            frames.append(FreshView(f"{k}", c, own))
    printed = check_views(rig, frames).powers
    assert [(p.kind, p.camera) for p in printed] == [(p.kind, p.camera) for p in promised]
    assert [p.chance for p in printed] == pytest.approx([p.chance for p in promised], abs=PROMISED_WITHIN)
    left = replace(rig, names=("left",), cameras=rig.cameras[:1], cam_from_rig=rig.cam_from_rig[:1])
    for_left, _ = informative_views(replace(left, covariance=rig.covariance[:8, :8]), [BOARD], FRESH)
    poses = [view.cam_from_board for view in for_left.views]
    rotation, shift = np.array([p.rotation for p in poses]), np.array([p.translation_mm for p in poses])
    held = BoardPoses(BOARD.points(), rotation, shift, np.ones((FRESH, BOARD.corner_count), bool))
    whole = board_in_view(rig.cameras[1], BOARD, held.transformed(MOUNT), Reach())
    seen = [held.seen, whole[:, None] & held.seen]
    others = _powers(rig, board_information(rig, BOARD, rotation, shift, seen))
    assert min(p.chance for p in others) < 0.9 * min(p.chance for p in promised)


def _powers(rig: Monitored, information: FloatArray) -> tuple[Power, ...]:
    """Return what frames of this information find."""
    sigma = rig.fresh_sigma_px
    evidence = FreshEvidence(
        information=information,
        score=np.zeros(information.shape[:2]),
        variance_px2=sigma**2,
        rms_px=sigma,
        expected_px=sigma,
        corners=1,
        left_out=0,
        overdispersion=1.0,
        freedom=rig.freedom,
    )
    return powers_of(rig, evidence, hypotheses_of(rig), ALARM_CHANCE)


def test_cameras_that_never_see_one_board_are_checked_lens_by_lens() -> None:
    rig = _rig(Rigid3(exp_so3(np.array([0.0, np.pi, 0.0])), [0.0, 0.0, -50.0]))
    plan, promised = informative_views(rig, [BOARD], 2)
    assert {view.seen_by for view in plan.views} == {("left",), ("right",)}
    assert all(np.isfinite(view.error) for view in plan.views) and _turn(promised) < 0.05
    assert plan_words(plan)[0].startswith("1. before camera 'left': ")
