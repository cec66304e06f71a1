"""The shape of a board is chosen by its held-out error on the same corners."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from helpers.calibration_scenes import random_views

from rigkit.calibration.calibrate import calibrate
from rigkit.cameras.kannala_brandt import KannalaBrandt
from rigkit.core.boards import Board
from rigkit.core.detections import BoardView

CAMERA = KannalaBrandt((1280, 960), np.array([384.0, 384.0, 638.0, 478.0, -0.01, 0.005, -0.003, 0.0005]))
BOARD = Board("b", 9, 6, 30.0, 30.0)
SMEARED = 5
"""From this column on the board is smeared in every third image: all its corners the same way, and each its own."""


def smeared_views(seed: int) -> list[BoardView]:
    rng = np.random.default_rng(seed)
    views, *_ = random_views(CAMERA, 16, rng, board=BOARD, noise_px=0.05, reach_deg=75.0)
    out = []
    for k, view in enumerate(views):
        pixels, smeared = view.pixels.copy(), view.grid[:, 0] >= SMEARED
        if k % 3 == 0:
            pixels[smeared] += rng.normal(0.0, 0.8, 2) + rng.normal(0.0, 0.3, (int(smeared.sum()), 2))
        out.append(replace(view, pixels=pixels))
    return out


@pytest.mark.parametrize("seed", [9, 11])
def test_a_warp_that_calls_more_corners_outliers_does_not_predict_better(seed: int) -> None:
    """On the corners that each shape keeps a warp came out better than the flat board that it is."""
    found = calibrate(smeared_views(seed), CAMERA.size_px, model="kannala_brandt")
    assert found.boards[0].kind == "flat"
    flat = calibrate(smeared_views(seed), CAMERA.size_px, model="kannala_brandt", board="flat")
    np.testing.assert_array_equal(found.camera.parameters, flat.camera.parameters)
