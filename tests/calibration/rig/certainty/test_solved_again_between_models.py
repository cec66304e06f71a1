"""Rival lens models widen a rig's uncertainty by the difference of its calibrations with them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from helpers.rig_scenes import MODELS, calibrated_rig, rig_views, sizes

from rigkit.calibration.result import Rival
from rigkit.calibration.rig import assemble
from rigkit.calibration.rig.calibrate import calibrate_rig
from rigkit.calibration.rig.certainty.solved_again import between_rig_models
from rigkit.calibration.rig.joint import JointRig
from rigkit.calibration.rig.result import RigCalibration
from rigkit.calibration.rig.solving.exposure_times import Lag
from rigkit.calibration.rig.verdicts import _worse
from rigkit.calibration.with_pupil import MOVING
from rigkit.core.arrays import FloatArray

LIKELY = 0.25
FIRST_ORDER = 0.1
"""A lens is followed to first order, by a model that cannot show all of it."""


@pytest.fixture
def given(monkeypatch: pytest.MonkeyPatch) -> dict[str, Any]:
    """Return what `between_rig_models` was given last."""
    arguments: dict[str, Any] = {}

    def keep(joint: JointRig, sigmas: FloatArray) -> FloatArray:
        arguments.update(joint=joint, sigmas=sigmas)
        return between_rig_models(joint, sigmas)

    monkeypatch.setattr(assemble, "between_rig_models", keep)
    return arguments


def extra_with(joint: JointRig, sigmas: FloatArray, rivals: Sequence[Rival | None]) -> FloatArray:
    """Return the contribution to the covariance of one rival of each camera, or None."""
    own = zip(joint.views.single, rivals, strict=True)
    single = tuple(replace(one, rivals=() if rival is None else (rival,)) for one, rival in own)
    return between_rig_models(replace(joint, views=replace(joint.views, single=single)), sigmas)


def baseline_sigma(rig: RigCalibration, extra: FloatArray) -> float:
    """Return the standard deviation of the baseline by this part of the covariance alone."""
    count = len(rig.covariance)
    alone = replace(rig, covariance=extra[:count, :count], scale_sigma=0.0, departures=())
    return alone.baseline_mm(*(camera.name for camera in rig.cameras))[1]


def test_a_rival_widens_the_baseline_by_its_own_difference(rng: np.random.Generator, given: dict[str, Any]) -> None:
    views = {name: own for name, own in rig_views(rng, 12).items() if name != "fish"}
    other = calibrate_rig(views, sizes(), model={**MODELS, "wide": "double_sphere"})
    rig = calibrate_rig(views, sizes(), model=MODELS)
    extra = extra_with(**given, rivals=(None, Rival("double_sphere", other.single[1].camera, LIKELY)))
    apart = abs(other.baseline_mm("reg", "wide")[0] - rig.baseline_mm("reg", "wide")[0])
    assert apart > 0.01
    assert baseline_sigma(rig, extra) == pytest.approx(np.sqrt(LIKELY) * apart, rel=FIRST_ORDER)
    assert not between_rig_models(**given).any()


def test_a_pupil_that_may_move_widens_the_baseline_by_its_difference(
    rng: np.random.Generator, given: dict[str, Any]
) -> None:
    """The rival has the same model and size as the central lens."""
    views = {name: own for name, own in rig_views(rng, 12).items() if name != "reg"}
    other = calibrate_rig(views, sizes(), model=MODELS, board="flat", pupil="moving")
    rig = calibrate_rig(views, sizes(), model=MODELS, board="flat", pupil="central")
    extra = extra_with(**given, rivals=[Rival(MOVING, one.camera, LIKELY) for one in other.single])
    apart = abs(other.baseline_mm("wide", "fish")[0] - rig.baseline_mm("wide", "fish")[0])
    assert apart > 0.01
    assert baseline_sigma(rig, extra) == pytest.approx(np.sqrt(LIKELY) * apart, rel=FIRST_ORDER)


def with_heldout_errors(alone: tuple[float | None, ...], together: float) -> RigCalibration:
    """Return a rig with these held-out errors (px) of its cameras alone and of its frames."""
    rig = calibrated_rig()
    single = [replace(one, heldout_rms_px=error) for one, error in zip(rig.single, alone, strict=False)]
    return replace(rig, single=tuple(single), heldout_rms_px=together)


@pytest.mark.parametrize(
    ("alone", "together", "printed"), [((0.1, 0.2), 0.3, True), ((0.1, 0.2), 0.16, False), ((0.1, None), 0.3, False)]
)
def test_held_out_frames_are_compared_with_the_cameras_alone(
    alone: tuple[float | None, ...], together: float, printed: bool
) -> None:
    """What a camera alone comes to is not known where its images were too few to hold some out."""
    assert bool(list(_worse(with_heldout_errors(alone, together), named=False))) == printed


@pytest.mark.parametrize(
    ("lags", "cause"), [({}, "not exactly synchronised"), ({"wide": Lag(0.1, 0.01, 0.0)}, "time lags vary")]
)
def test_solved_lags_are_not_named_as_a_cause_again(lags: dict[str, Lag], cause: str) -> None:
    """Frames worse than the cameras alone are explained by moments only as far as those were not solved for."""
    (finding,) = _worse(replace(with_heldout_errors((0.1, 0.2), 0.3), lags=lags), named=False)
    assert cause in finding.message
