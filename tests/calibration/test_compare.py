from __future__ import annotations

import itertools
from dataclasses import replace

import numpy as np
import pytest
from helpers.calibration_scenes import REACH_DEG, lens, random_views

from rigkit.calibration.calibrate import calibrate
from rigkit.calibration.compare import compare_calibrations
from rigkit.calibration.result import Calibration

SEEDS = 6
MOVED_PX = 3.0
"""A focal length that changed by this much is a lens that was touched; calibrations here know it to 0.3 px."""


@pytest.fixture(scope="module")
def calibrations() -> list[Calibration]:
    """Calibrations of one camera from different views."""
    out = []
    for seed in range(SEEDS):
        camera = lens("fish")
        views, _, _ = random_views(camera, 15, np.random.default_rng(seed), reach_deg=REACH_DEG["fish"])
        out.append(calibrate(views, camera.size_px, model="kannala_brandt", board="flat"))
    return out


def test_calibrations_of_one_camera_are_the_same(calibrations: list[Calibration]) -> None:
    results = [compare_calibrations(a, b) for a, b in itertools.pairwise(calibrations)]
    assert all(result.same for result in results)
    ratio = float(np.median([result.ratio for result in results]))
    assert 0.4 < ratio < 1.6
    assert np.median([result.chance for result in results]) > 0.1


def test_a_moved_lens_is_another_camera(calibrations: list[Calibration]) -> None:
    a, b = calibrations[0], calibrations[1]
    shift = np.zeros(b.camera.parameters.size)
    shift[:2] = MOVED_PX
    moved = replace(b, camera=b.camera.with_parameters(b.camera.parameters + shift))
    result = compare_calibrations(a, moved)
    assert not result.same
    assert result.ratio > 2.0
