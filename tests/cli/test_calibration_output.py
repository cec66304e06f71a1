"""Images that are left out are grouped by reason in what `rigkit calibrate` prints."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from helpers.calibration_scenes import SIZE, lens, random_views

from rigkit.calibration.calibrate import calibrate
from rigkit.cli.calibration_output import first_finding, frames_left_out, left_out
from rigkit.core.findings import Finding


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


def test_frames_left_out_for_one_reason_are_one_line() -> None:
    """Of a video with loose triggers there may be dozens, which differ in their figures only."""
    targets = [(f"{k:06d}", "wall", f"the cameras disagree ({10.5 + k} times)") for k in range(5)]
    assert frames_left_out([*targets, ("000009", "floor", "its boards disagree")]) == [
        "frames 000000, 000001, 000002 and 2 more, board 'wall' left out: the cameras disagree (10.5 times) (figures "
        "of the first)",
        "frame 000009, board 'floor' left out: its boards disagree",
    ]


def test_reasons_that_verdicts_state_are_not_said_again() -> None:
    """A message that only ends like one states none."""
    views = random_views(lens("reg"), 6, np.random.default_rng(1), reach_deg=30.0)[0]
    calibration = calibrate(views, SIZE, model="brown", board="flat", folds=0)
    no_board = Finding.left_out("held-out RMS 0.1 px, but image 'a.png' is left out", "no board found", "a.png")
    stated = (no_board, Finding.look("the lens: is damaged"))
    dropped = (("a.png", "no board found"), ("b.png", "is damaged"))
    assert left_out(replace(calibration, dropped=dropped, verdicts=stated)) == ["dropped b.png: is damaged"]


def test_a_camera_of_a_rig_is_one_line() -> None:
    found = [Finding.bad("one"), Finding.bad("two"), Finding.look("three")]
    assert first_finding("left", found) == ["'left' by itself: bad: one; 2 more findings (1 bad) on the page (-r)"]
    assert first_finding("left", found[:1]) == ["'left' by itself: bad: one"]
    assert first_finding("left", []) == []
