"""A focal length that drifts over a session, and what resembles it."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest
from helpers.calibration_scenes import SIZE, lens, random_views

from rigkit.calibration.calibrate import calibrate
from rigkit.calibration.diagnosis.changing import drifting
from rigkit.calibration.diagnosis.view_evidence import view_evidence
from rigkit.calibration.result import Calibration
from rigkit.cameras.base import image_center
from rigkit.core.arrays import FloatArray
from rigkit.core.findings import Severity


def zoomed(zoom: FloatArray, rng: np.random.Generator) -> Calibration:
    """Return the calibration of images each of which has a focal length of its own."""
    views, _, _ = random_views(lens("reg"), len(zoom), rng, reach_deg=33.0, noise_px=0.05)
    middle = (np.array(SIZE) - 1.0) / 2.0
    own = [
        replace(view, image=f"{k:02d}.png", pixels=middle + (view.pixels - middle) * by)
        for k, (view, by) in enumerate(zip(views, zoom.tolist(), strict=True))
    ]
    inside = [((v.pixels > 0.0) & (v.pixels < np.array(SIZE) - 1.0)).all(axis=1) for v in own]
    own = [
        replace(v, pixels=v.pixels[i], grid=v.grid[i], sigma_px=v.sigma_px[i]) for v, i in zip(own, inside, strict=True)
    ]
    return calibrate(own, SIZE, model="brown", board="flat")


def test_a_drift_is_named_first_with_its_size(rng: np.random.Generator) -> None:
    """It may also be taken for two lenses, before some image and from it on."""
    result = zoomed(np.linspace(1.0, 0.98, 20), rng)
    found = result.verdicts[0]
    assert found.severity is Severity.BAD
    assert any(words in found.message for words in ("drifts over the session", "the lens (or the board) changed"))
    evidence = view_evidence(result)
    assert evidence is not None
    drift = drifting(result, evidence)
    assert drift is not None
    percent = re.search(r"by ([\d.]+) % from the first image", drift.message)
    assert percent is not None and float(percent[1]) == pytest.approx(2.0, abs=0.6)


def test_a_zoom_at_random_is_no_drift(rng: np.random.Generator) -> None:
    found = zoomed(1.0 + 0.01 * rng.standard_normal(20), rng).verdicts
    assert found[0].severity is not Severity.GOOD
    assert not any("drifts" in str(verdict) for verdict in found)


def test_one_focal_length_does_not_drift(rng: np.random.Generator) -> None:
    result = zoomed(np.ones(20), rng)
    evidence = view_evidence(result)
    assert evidence is not None and drifting(result, evidence) is None


def test_views_without_kept_corners_or_all_at_one_place_are_no_error(rng: np.random.Generator) -> None:
    result = zoomed(np.linspace(1.0, 0.98, 20), rng)
    evidence = view_evidence(result)
    assert evidence is not None
    first, *others = result.views
    without = replace(result, views=(replace(first, kept=np.zeros_like(first.kept)), *others))
    assert drifting(without, evidence) is not None
    middle = image_center(SIZE)
    at_one = tuple(replace(view, pixels=np.tile(middle, (len(view.pixels), 1))) for view in result.views)
    assert drifting(replace(result, views=at_one), evidence) is None
