"""A camera that slips on its rig between two frames is named; frames of several moments are not called that."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from helpers.calibration_scenes import BOARD, lens
from helpers.rig_scenes import Views

from rigkit.calibration.rig.calibrate import calibrate_rig
from rigkit.core.detections import BoardView
from rigkit.core.findings import Severity
from rigkit.geometry.rigid3 import Rigid3
from rigkit.geometry.rotation import exp_so3

NOISE_PX, FRAMES, SLIP = 0.05, 12, 6
LENS = lens("reg")
RIGHT_FROM_LEFT = Rigid3(exp_so3(np.array([0.01, -0.05, 0.02])), [-100.0, 2.0, 1.0])
SLIPPED = Rigid3(exp_so3(np.array([0.004, -0.055, 0.026])), [-100.0, 2.0, 1.0])
"""Half a degree further."""


def frames(rng: np.random.Generator, move_mm: float, slipped: Rigid3) -> Views:
    """Return frames of two cameras, the right one mounted otherwise from frame SLIP on, between whose exposures the
    board moves."""
    views: Views = {"left": [], "right": []}
    while len(views["left"]) < FRAMES:
        k = len(views["left"])
        rotation = exp_so3(rng.normal(size=3) * np.array([0.4, 0.4, 0.3]))
        place = np.array([rng.uniform(-80, 150), rng.uniform(-90, 90), rng.uniform(400, 700)])
        left_from_board = Rigid3(rotation, place - rotation @ BOARD.points().mean(axis=0))
        later = Rigid3(rotation, left_from_board.translation_mm + move_mm * rng.normal(size=3))
        poses = {"left": left_from_board, "right": (RIGHT_FROM_LEFT if k < SLIP else slipped) @ later}
        shown = {}
        for name, pose in poses.items():
            pixels, valid = LENS.project(pose.apply(BOARD.points()))
            if valid.all() and LENS.on_image(pixels).all():
                noisy = pixels + NOISE_PX * rng.normal(size=pixels.shape)
                shown[name] = np.clip(noisy, 0, np.array(LENS.size_px) - 1)
        if len(shown) == 2:
            for name, pixels in shown.items():
                sigma = np.full(len(pixels), NOISE_PX)
                views[name].append((f"{k}", BoardView(f"{name}{k}.png", BOARD, BOARD.grid(), pixels, sigma)))
    return views


def first_verdict(views: Views) -> str:
    rig = calibrate_rig(views, dict.fromkeys(views, LENS.size_px), model="brown", degree=4, folds=0)
    assert rig.verdicts[0].severity is Severity.BAD
    return rig.verdicts[0].message


def test_the_frame_is_named_from_which_a_camera_sits_elsewhere(rng: np.random.Generator) -> None:
    message = first_verdict(frames(rng, 0.0, SLIPPED))
    assert f"camera 'right' or 'left' moved on the rig before frame '{SLIP}'" in message
    assert "(0.5" in message


@pytest.mark.parametrize("seed", range(3))
def test_boards_that_move_between_exposures_are_no_slip(seed: int) -> None:
    views = frames(np.random.default_rng(seed), 5.0, RIGHT_FROM_LEFT)
    assert "moved on the rig" not in first_verdict(views)


def test_a_camera_whose_focus_changed_comes_before_the_rig(rng: np.random.Generator) -> None:
    views = frames(rng, 0.0, RIGHT_FROM_LEFT)
    middle = 0.5 * (np.array(LENS.size_px) - 1.0)
    views["right"] = [
        (f, replace(v, pixels=middle + 0.98 * (v.pixels - middle)) if int(f) >= SLIP else v) for f, v in views["right"]
    ]
    message = first_verdict(views)
    assert "camera 'right': the " in message and "the stated uncertainties are invalid" in message
