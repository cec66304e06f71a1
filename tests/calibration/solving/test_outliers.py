"""Corners that deviate together with their neighbours are kept; corners that deviate alone are outliers."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from helpers.calibration_scenes import REACH_DEG, SIZE, lens, random_views

from rigkit.calibration.calibrate import calibrate

BENT_PX = 0.7
"""At the ends of a board that bends in one picture."""


def test_a_board_that_bends_in_one_picture_has_no_outliers(rng: np.random.Generator) -> None:
    views, *_ = random_views(lens("reg"), 12, rng, reach_deg=REACH_DEG["reg"], noise_px=0.05)
    along = (views[0].grid[:, 0] - 4.0) / 4.0
    pixels = views[0].pixels + BENT_PX * (along**2 * np.abs(along))[:, None] * np.array([0.6, 0.8])
    alone = np.array([7, 30])
    pixels[alone] += [1.5, -1.5]
    result = calibrate([replace(views[0], pixels=pixels), *views[1:]], SIZE, model="brown", board="flat")
    assert {(o.image, o.column, o.row) for o in result.outliers} == {
        (views[0].image, *views[0].grid[k].tolist()) for k in alone
    }


def test_a_view_most_of_whose_corners_disagree_is_still_dropped(rng: np.random.Generator) -> None:
    views, *_ = random_views(lens("reg"), 12, rng, reach_deg=REACH_DEG["reg"], noise_px=0.05)
    off = views[0].pixels - views[0].pixels.mean(axis=0)
    bent = views[0].pixels + 8.0 * (off / np.abs(off).max()) ** 2 * [1.0, -1.0]
    result = calibrate([replace(views[0], pixels=bent), *views[1:]], SIZE, model="brown", board="flat")
    assert [image for image, _ in result.dropped] == [views[0].image]
