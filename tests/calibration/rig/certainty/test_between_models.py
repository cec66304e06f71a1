"""Rival lens models widen a rig's uncertainty by the difference of its calibrations with them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from helpers.rig_scenes import MODELS, calibrated_rig, rig_views, sizes

from rigkit.calibration.result import Rival
from rigkit.calibration.rig import assemble
from rigkit.calibration.rig.calibrate import calibrate_rig
from rigkit.calibration.rig.certainty.between_models import between_rig_models
from rigkit.calibration.rig.result import RigCalibration
from rigkit.calibration.rig.solving.exposure_times import Lag
from rigkit.calibration.rig.verdicts import _worse

LIKELY = 0.25
FIRST_ORDER = 0.1
"""A lens is followed to first order, by a model that cannot show all of it."""


def test_a_rival_widens_the_baseline_by_its_own_difference(
    rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch
) -> None:
    views = {name: own for name, own in rig_views(rng, 12).items() if name != "fish"}
    given = {}

    def keep(*arguments: object) -> np.ndarray:
        given["arguments"] = arguments
        return between_rig_models(*arguments)  # type: ignore[arg-type]

    monkeypatch.setattr(assemble, "between_rig_models", keep)
    other = calibrate_rig(views, sizes(), model={**MODELS, "wide": "double_sphere"})
    rig = calibrate_rig(views, sizes(), model=MODELS)
    joint, sigmas = given["arguments"]
    single = joint.views.single  # type: ignore[attr-defined]
    rival = Rival("double_sphere", other.single[1].camera, LIKELY)
    views_with_rival = replace(joint.views, single=(single[0], replace(single[1], rivals=(rival,))))  # type: ignore[attr-defined]
    extra = between_rig_models(replace(joint, views=views_with_rival), sigmas)  # type: ignore[arg-type, type-var]
    count = len(rig.covariance)
    length, _ = rig.baseline_mm("reg", "wide")
    apart = abs(other.baseline_mm("reg", "wide")[0] - length)
    alone = replace(rig, covariance=extra[:count, :count], scale_sigma=0.0, departures=())
    assert apart > 0.01
    assert alone.baseline_mm("reg", "wide")[1] == pytest.approx(np.sqrt(LIKELY) * apart, rel=FIRST_ORDER)
    assert not between_rig_models(joint, sigmas).any()  # type: ignore[arg-type]


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
    assert bool(list(_worse(with_heldout_errors(alone, together)))) == printed


@pytest.mark.parametrize(
    ("lags", "cause"), [({}, "not exactly synchronised"), ({"wide": Lag(0.1, 0.01, 0.0)}, "time lags vary")]
)
def test_solved_lags_are_not_named_as_a_cause_again(lags: dict[str, Lag], cause: str) -> None:
    """Frames worse than the cameras alone are explained by moments only as far as those were not solved for."""
    (finding,) = _worse(replace(with_heldout_errors((0.1, 0.2), 0.3), lags=lags))
    assert cause in finding.message
