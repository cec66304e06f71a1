"""Lenses that depart from their models make cameras disagree; frames that were not taken at one moment do so, too."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from helpers.rig_scenes import MODELS, SIGMAS, Views, mounts, rig_views, sizes

from rigkit.calibration.rig.calibrate import calibrate_rig
from rigkit.kernels.departures import DISPLACEMENTS, displacements

DEPART_PX, MOVED_PX = 2.0, 4.0
SAID = "not simultaneous"


def moved(views: Views, by_px: float, departs_px: float) -> Views:
    """Return views through lenses that depart at random, the last camera's of boards that have moved since."""
    rng = np.random.default_rng(0)
    out: Views = {name: [] for name in views}
    for name, own in views.items():
        size, amounts = sizes()[name], departs_px * rng.normal(size=DISPLACEMENTS)
        for frame, view in own:
            pixels = view.pixels + np.einsum("ijn,j->ni", displacements(view.pixels, size), amounts)
            pixels = pixels + (by_px * rng.normal(size=2) if name == "fish" else 0.0)
            out[name].append((frame, replace(view, pixels=np.clip(pixels, 0.0, np.array(size) - 1.0))))
    return out


def test_lenses_that_depart_are_not_held() -> None:
    views = moved(rig_views(np.random.default_rng(2), 8), 0.0, DEPART_PX)
    rig = calibrate_rig(views, sizes(), model=MODELS, folds=0)
    assert SAID not in str(rig.verdicts)
    length, sigma = rig.baseline_mm("reg", "wide")
    assert abs(length - np.linalg.norm(mounts()["wide"][1].inverse().translation_mm)) < SIGMAS * sigma


@pytest.mark.parametrize(("frames", "seed", "departs_px"), [(8, 2, 0.0), (8, 2, DEPART_PX), (3, 3, 0.0)])
def test_frames_that_are_not_simultaneous_are_no_departures(frames: int, seed: int, departs_px: float) -> None:
    """In three frames the amounts of three lenses would explain anything."""
    views = moved(rig_views(np.random.default_rng(seed), frames), MOVED_PX, departs_px)
    assert SAID in str(calibrate_rig(views, sizes(), model=MODELS, folds=0).verdicts)
