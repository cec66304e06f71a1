"""Pictures to check a lens with: what they promise is what the check then says, and others tell less."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from helpers.calibration_scenes import BOARD, lens

from rigkit.calibration.calibrate import calibrate
from rigkit.calibration.result import Calibration
from rigkit.core.detections import BoardView
from rigkit.core.errors import InputError
from rigkit.geometry.rigid3 import Rigid3
from rigkit.planning.goal import projection_goal
from rigkit.planning.information import CornerError, Knowledge
from rigkit.planning.plan import Plan, plan_views
from rigkit.validation.sentinel.evidence import FreshView
from rigkit.validation.sentinel.judge import SentinelCheck, check_views
from rigkit.validation.sentinel.telling import views_that_tell
from rigkit.validation.sentinel.watch import watched_camera

NOISE_PX = 0.05
FRESH = 3
PROMISED_WITHIN = 0.01
"""The chance promised is linearised at the calibration, and the board as stated; the check's at fresh corners."""


def _views(plan: Plan, rng: np.random.Generator) -> list[BoardView]:
    camera, out = lens("wide"), []
    for k, view in enumerate(plan.views):
        pixels, valid = camera.project(view.cam_from_board.apply(BOARD.points()))
        assert valid.all() and camera.on_image(pixels).all()
        noisy = pixels + NOISE_PX * rng.standard_normal(pixels.shape)
        out.append(BoardView(f"{k}", BOARD, BOARD.grid(), noisy, np.full(len(noisy), NOISE_PX)))
    return out


@pytest.fixture(scope="module")
def calibration() -> Calibration:
    camera = lens("wide")
    known = Knowledge.guessed(camera, CornerError(NOISE_PX))
    plan = plan_views(known, [BOARD], projection_goal(camera), 14)
    views = _views(plan, np.random.default_rng(2))
    return calibrate(views, camera.size_px, model=camera.model, board="flat", folds=0)


def _checked(calibration: Calibration, plan: Plan, rng: np.random.Generator) -> SentinelCheck:
    fresh = [FreshView(view.image, 0, view) for view in _views(plan, rng)]
    return check_views(watched_camera(calibration, "cam"), fresh)


def test_pictures_find_what_was_promised_and_more_than_others(calibration: Calibration) -> None:
    plan, promised = views_that_tell(watched_camera(calibration, "cam"), [BOARD], FRESH)
    said = _checked(calibration, plan, np.random.default_rng(3)).powers
    assert [p.kind for p in said] == [p.kind for p in promised] and len(said) == 3
    for one, other in zip(said, promised, strict=True):
        assert one.chance == pytest.approx(other.chance, abs=PROMISED_WITHIN)
    # What improves the calibration most is not what tells changes best: a focus is seen worst.
    improving = plan_views(Knowledge.of(calibration), [BOARD], projection_goal(calibration.camera), FRESH)
    worst = min(p.chance for p in _checked(calibration, improving, np.random.default_rng(3)).powers)
    assert 0.05 < worst < 0.9 * min(p.chance for p in promised)


def test_each_picture_tells_more(calibration: Calibration) -> None:
    plan, _ = views_that_tell(watched_camera(calibration, "cam"), [BOARD], FRESH)
    errors = [plan.error, *(view.error for view in plan.views)]
    assert not np.isfinite(errors[0])
    assert all(after < before for before, after in pairwise(errors))


def test_a_rig_has_no_pictures_to_check_with(calibration: Calibration) -> None:
    one = watched_camera(calibration, "left")
    rig = replace(
        one,
        names=("left", "right"),
        cameras=one.cameras * 2,
        cam_from_rig=(Rigid3.identity(), Rigid3(np.eye(3), [100.0, 0.0, 0.0])),
        covariance=np.eye(24),
    )
    with pytest.raises(InputError, match="one camera"):
        views_that_tell(rig, [BOARD], FRESH)
