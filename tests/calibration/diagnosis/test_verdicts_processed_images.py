"""Images that a program cropped, resized or undistorted among those of the camera: named, and never "good"."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from helpers.calibration_scenes import SIZE, lens, random_views

from rigkit.calibration.calibrate import calibrate
from rigkit.core.arrays import Pixels
from rigkit.core.detections import BoardView
from rigkit.core.findings import Severity

CROPPED_PX, RESIZED = 64.0, 0.9


def processed(how: str, pixels: Pixels) -> Pixels:
    """Return where corners (N, 2) are in images of the same size that a program made."""
    if how == "cropped":
        return pixels - CROPPED_PX
    if how == "resized":
        return (pixels + 0.5) * RESIZED - 0.5
    camera = lens("reg")
    rays, _ = camera.unproject(pixels)
    return np.asarray(camera.parameters[:2] * rays[:, :2] / rays[:, 2:] + camera.parameters[2:4])


def as_made(how: str, view: BoardView) -> BoardView:
    pixels = processed(how, view.pixels)
    shown = ((pixels >= 0.0) & (pixels <= np.array(SIZE) - 1.0)).all(axis=1)
    assert view.sigma_px is not None
    return replace(view, pixels=pixels[shown], grid=view.grid[shown], sigma_px=view.sigma_px[shown])


@pytest.mark.parametrize("how", ["cropped", "resized", "undistorted"])
@pytest.mark.parametrize("which", ["every second one", "copies"])
def test_images_that_a_program_changed(how: str, which: str, rng: np.random.Generator) -> None:
    views, _, _ = random_views(lens("reg"), 14, rng, reach_deg=28.0, noise_px=0.05)
    if which == "copies":
        session = [*views, *(replace(as_made(how, view), image=f"{how} {view.image}") for view in views)]
    else:
        session = [as_made(how, view) if k % 2 else view for k, view in enumerate(views)]
    headline = calibrate(session, SIZE, model="brown", board="flat").verdicts[0]
    assert headline.severity is Severity.BAD
    assert "a program" in headline.text
