"""When the lens changed during a session: the first image after the change, or none if that is not determined."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from helpers.calibration_scenes import SIZE, lens, random_views

from rigkit.calibration.calibrate import calibrate
from rigkit.calibration.result import Calibration
from rigkit.core.detections import BoardView


def first(found: Calibration) -> str:
    return found.verdicts[0].message


def zoomed(later: range | tuple[int, ...], longer: float, rng: np.random.Generator) -> list[BoardView]:
    """Return 20 images, those that are `later` of a focal length so many times as long."""
    camera, views = lens("reg"), []
    other = camera.with_parameters(camera.parameters * np.array([longer, longer, *[1.0] * 7]))
    for k in range(20):
        view = random_views(other if k in later else camera, 1, rng, reach_deg=33.0, noise_px=0.03)[0][0]
        views.append(replace(view, image=f"{k:03d}.png"))
    return views


@pytest.mark.parametrize(("moment", "longer"), [(10, 1.02), (7, 0.995), (14, 1.005)])
def test_a_zoom_is_told_with_its_moment_and_no_other_cause(
    moment: int, longer: float, rng: np.random.Generator
) -> None:
    found = calibrate(zoomed(range(moment, 20), longer, rng), SIZE, model="brown", board="flat")
    assert f"the lens (or the board) changed at image '{moment:03d}.png'" in first(found)
    assert "stated uncertainties are invalid" in first(found)
    assert not any(words in str(found.verdicts) for words in ("rolling shutter", "from image to image", "two groups"))


@pytest.mark.parametrize(("moment", "words"), [(6, "before '006.png'"), (15, "from '015.png' on")])
def test_images_left_out_are_told_with_their_moment(moment: int, words: str, rng: np.random.Generator) -> None:
    """So few of another zoom that the others hold: these are left out."""
    found = calibrate(zoomed(range(moment, 20), 0.85, rng), SIZE, model="brown", board="flat")
    out = min(moment, 20 - moment)
    assert f"{out} of 20 images are inconsistent with the others and left out, all {words}" in first(found)


def test_a_zoom_in_turns_has_no_moment(rng: np.random.Generator) -> None:
    """Wherever such images are parted, those of either side are of both lenses: in any order as much."""
    turns = (0, 3, 4, 6, 9, 11, 12, 13, 17, 19)
    found = calibrate(zoomed(turns, 1.15, rng), SIZE, model="brown", board="flat")
    assert "two groups" in first(found) and "(or the board) changed" not in str(found.verdicts)
