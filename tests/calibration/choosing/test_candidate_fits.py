"""A rig reuses the calibrations of its single cameras, with the same result to the last bit."""

from __future__ import annotations

import pickle
from dataclasses import replace

import numpy as np
import pytest
from helpers.calibration_scenes import BOARD, REACH_DEG, SIZE, lens, random_views

from rigkit.calibration.calibrate import calibrate_together
from rigkit.calibration.choosing.candidate_fits import fit_candidates
from rigkit.calibration.choosing.models_tried import Request
from rigkit.core.detections import BoardView
from rigkit.core.progress import silent

HOW = Request(size_px=SIZE, model="auto", degree=None, board="auto", folds=2, progress=silent, pupil="auto")


@pytest.fixture(scope="module")
def views() -> list[BoardView]:
    x, y = (BOARD.points()[:, :2] / BOARD.points()[:, :2].max(axis=0)).T
    bowed = BOARD.points() + np.stack([0.0 * x, 0.0 * x, 4.0 * x * (1.0 - x) + 0.0 * y], axis=-1)
    rng = np.random.default_rng(4)
    return random_views(lens("reg"), 8, rng, reach_deg=REACH_DEG["reg"], noise_px=0.1, points_mm=bowed)[0]


def test_a_rig_reuses_the_calibration_of_a_camera_alone(
    views: list[BoardView], monkeypatch: pytest.MonkeyPatch
) -> None:
    candidate_fits = fit_candidates("", views, HOW)
    (alone,) = calibrate_together([("", views, HOW)], known=[candidate_fits])
    in_rig = [("left", views, replace(HOW, pupil="central"))]
    (expected,) = calibrate_together(in_rig)
    assert alone.boards[0].kind != "flat", "lenses are compared on boards as they were found, too"
    # As it comes from the process in which the camera was calibrated.
    known = pickle.loads(pickle.dumps(candidate_fits))

    def again(*_: object) -> None:
        raise AssertionError("done again")

    for step in (
        "candidate_fits.fit_all",
        "candidate_fits.solved",
        "candidate_fits.fit_other_lens",
        "candidate_fits.heldout_squares",
    ):
        monkeypatch.setattr(f"rigkit.calibration.choosing.{step}", again)
    (found,) = calibrate_together(in_rig, known=[known])
    np.testing.assert_array_equal(found.camera.parameters, expected.camera.parameters)
    np.testing.assert_array_equal(found.frame_covariance, expected.frame_covariance)
    assert found.heldout_rms_px == expected.heldout_rms_px


def test_other_views_or_options_reuse_nothing(views: list[BoardView]) -> None:
    known = fit_candidates("", views, replace(HOW, model="brown", degree=5, board="flat", folds=0))
    assert known.for_request("left", views, known.request) is not None
    moved = [*views[:-1], replace(views[-1], pixels=views[-1].pixels + 0.1)]
    for other in (moved, views[:-1], [*views[:-1], replace(views[-1], image="other")]):
        assert known.for_request("left", other, known.request) is None
    for request in (replace(known.request, folds=2), replace(known.request, board="auto"), HOW):
        assert known.for_request("left", views, request) is None
