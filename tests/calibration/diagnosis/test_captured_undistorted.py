"""Images that show no distortion, which few lenses take."""

from __future__ import annotations

import numpy as np
import pytest
from helpers.calibration_scenes import SIZE, lens, random_views

from rigkit.calibration.calibrate import calibrate
from rigkit.cameras.base import Camera
from rigkit.cameras.brown import Brown

WITHOUT = Brown(SIZE, np.array([1200.0, 1200.0, 801.0, 595.0, 0.0, 0.0, 0.0, 0.0, 0.0]))
SLIGHT = Brown(SIZE, np.array([1200.0, 1200.0, 801.0, 595.0, -0.02, 0.0, 0.0, 0.0, 0.0]))
MOUSTACHE = Brown(SIZE, np.array([2000.0, 2000.0, 801.0, 595.0, -0.025, 0.1, 0.0, 0.0, 0.0]))
"""At most 0.14 % of the radius, and none in the corners."""
WORDS = "the images show no distortion"


@pytest.mark.parametrize(
    ("camera", "model", "reported"),
    [
        (WITHOUT, "pinhole", True),
        (WITHOUT, "brown", True),
        (SLIGHT, "brown", False),
        (MOUSTACHE, "brown", False),
        (lens("fish"), "scaramuzza", False),
    ],
)
def test_no_distortion_is_said_first(camera: Camera, model: str, reported: bool, rng: np.random.Generator) -> None:
    views, _, _ = random_views(camera, 16, rng, reach_deg=25.0, noise_px=0.02)
    found = calibrate(views, SIZE, model=model, board="flat", folds=0)
    assert (WORDS in str(found.verdicts[0])) == any(WORDS in str(verdict) for verdict in found.verdicts) == reported


@pytest.mark.parametrize(("k1", "reported"), [(3e-4, True), (-0.01, False)])
def test_what_an_undistorting_program_leaves_grows_off_axis(
    k1: float, reported: bool, rng: np.random.Generator
) -> None:
    wide = Brown(SIZE, np.array([600.0, 600.0, 801.0, 595.0, k1, 0.0, 0.0, 0.0, 0.0]))
    views, _, _ = random_views(wide, 16, rng, reach_deg=55.0, noise_px=0.02)
    found = calibrate(views, SIZE, model="brown", board="flat", folds=0)
    assert (WORDS in str(found.verdicts[0])) == reported


def test_a_narrow_lens_may_have_none(rng: np.random.Generator) -> None:
    narrow = Brown(SIZE, np.array([6000.0, 6000.0, 801.0, 595.0, 0.0, 0.0, 0.0, 0.0, 0.0]))
    views, _, _ = random_views(narrow, 16, rng, reach_deg=6.0, noise_px=0.05)
    found = calibrate(views, SIZE, model="pinhole", board="flat", folds=0)
    assert not any(WORDS in str(verdict) for verdict in found.verdicts)


def test_a_lens_that_few_parts_of_the_image_show_is_not_said_to_be_without(rng: np.random.Generator) -> None:
    """A pinhole is fitted to boards in a corner: their few degrees determine no distortion."""
    views, _, _ = random_views(SLIGHT, 60, rng, reach_deg=25.0, noise_px=0.3)
    aside = [view for view in views if (view.pixels.mean(axis=0) > (900.0, 650.0)).all()]
    assert len(aside) >= 5
    found = calibrate(aside, SIZE, model="pinhole", board="flat", folds=0)
    assert any("the projection uncertainty reaches" in str(verdict) for verdict in found.verdicts)
    assert not any(WORDS in str(verdict) for verdict in found.verdicts)
