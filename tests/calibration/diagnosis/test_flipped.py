"""Flipping the images of views as arrays: it agrees with flipping each view and its pose."""

import numpy as np
import pytest
from helpers.calibration_scenes import SIZE, lens, random_views

from rigkit.calibration.diagnosis.flipped import _flipped, _with_views
from rigkit.calibration.solving.state import State, evaluate
from rigkit.calibration.views.flips import FLIP_SIGNS, Flip
from rigkit.calibration.views.observations import Observations
from rigkit.cameras.base import image_center
from rigkit.geometry.rigid3 import Rigid3


@pytest.mark.parametrize("way", FLIP_SIGNS)
@pytest.mark.parametrize("turns", [0, 2])
def test_flipped_arrays_are_those_of_flipped_views(way: str, turns: int) -> None:
    camera = lens("wide", image_center(SIZE))
    views, rotation, translation = random_views(camera, 3, np.random.default_rng(0), reach_deg=55.0)
    observations = Observations.from_views(views)
    state = State.start(camera, rotation, translation, observations)
    before = evaluate(state, observations).px
    at = np.array([True, False, True])
    out, moved = _flipped(way, at, np.full(3, turns), observations, state)
    signs = np.array(FLIP_SIGNS[way])
    mirrored = signs.prod() < 0.0
    flip = Flip(FLIP_SIGNS[way], None if not mirrored else 1 if turns else 0)
    shown = _with_views(out)
    for k in (0, 2):
        expected, grid = flip.view(views[k], image_center(SIZE)), shown.views[k].grid
        if turns and not mirrored:
            expected_grid = np.array(views[k].board.size) - 1 - views[k].grid
        else:
            expected_grid = expected.grid
            pose = flip.pose(Rigid3(rotation[k], translation[k]), views[k].board)
            assert np.allclose(moved.rotation[k], pose.rotation)
            assert np.allclose(moved.translation_mm[k], pose.translation_mm)
        assert np.array_equal(grid, expected_grid)
        assert np.allclose(shown.views[k].pixels, expected.pixels)
        assert np.array_equal(out.corner[k], views[k].board.index(grid))
    # The lens is symmetric.
    after = evaluate(moved, out).px
    assert np.allclose(after[at], signs * before[at])
    assert np.array_equal(after[~at], before[~at])
