"""Images that are left out are grouped by reason in what `rigkit calibrate` prints."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from helpers.calibration_scenes import SIZE, lens, random_views

from rigkit.calibration.calibrate import calibrate
from rigkit.cli.calibration_output import left_out


def test_a_reason_is_said_once_with_its_first_images() -> None:
    nothing = [(f"f{k:03d}.png", "no board found") for k in range(200)]
    dropped = (("one.png", "is damaged"), *nothing, ("000.png", "board 'b' lies beside"), ("two.png", "is damaged"))
    views = random_views(lens("reg"), 6, np.random.default_rng(1), reach_deg=30.0)[0]
    calibration = calibrate(views, SIZE, model="brown", board="flat", folds=0)
    assert left_out(replace(calibration, dropped=dropped)) == [
        "dropped one.png, two.png: is damaged",
        "dropped f000.png, f001.png, f002.png and 197 more: no board found",
        "left out of 000.png: board 'b' lies beside",
    ]
