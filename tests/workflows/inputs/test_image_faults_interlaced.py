"""Interlaced images (two moments, line by line) are recognised, others never."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from helpers.calibration_scenes import random_views

from rigkit.calibration.calibrate import calibrate
from rigkit.cameras.brown import Brown
from rigkit.core.arrays import FloatArray
from rigkit.detection.fields import shift_between_fields
from rigkit.workflows.inputs.image_faults import interlaced

SIZE = (640, 480)
CAMERA = Brown(SIZE, np.array([540.0, 540.0, 320.0, 240.0, -0.2, 0.1, 0.0, 0.0, 0.0]))


def picture(shift_px: float, rng: np.random.Generator) -> FloatArray:
    """Return a picture (H, W) with slopes both ways, odd lines shifted to the right."""
    whole = 128.0 + 300.0 * cv2.GaussianBlur(rng.normal(size=SIZE[::-1]), (0, 0), 2.0)
    u, v = np.meshgrid(np.arange(SIZE[0], dtype=np.float32), np.arange(SIZE[1], dtype=np.float32))
    odd = (v % 2 == 1) * np.float32(shift_px)
    return np.asarray(cv2.remap(whole.astype(np.float32), u - odd, v, cv2.INTER_CUBIC), dtype=np.float64)


@pytest.mark.parametrize("shift_px", [-0.5, 0.0, 0.5])
@pytest.mark.parametrize("first", [60.0, 61.0])
def test_the_shift_between_fields_is_measured(shift_px: float, first: float, rng: np.random.Generator) -> None:
    """With its sign, at whichever line the board begins."""
    found = shift_between_fields(picture(shift_px, rng), np.array([[50.0, first], [400.0, 300.0]]))
    assert abs(found - shift_px) < 0.05


def test_an_image_without_texture_says_nothing() -> None:
    assert shift_between_fields(np.full((40, 40), 7.0), np.array([[10.0, 10.0], [30.0, 30.0]])) == 0.0
    assert shift_between_fields(np.zeros((2, 2)), np.zeros((1, 2))) == 0.0


def test_interlaced_images_are_called_that(tmp_path: Path, rng: np.random.Generator) -> None:
    """Where the camera stood still in one of them, too; one image alone tells nothing, nor do files that are gone."""
    views, _, _ = random_views(CAMERA, 8, rng, reach_deg=25.0)
    result = calibrate(views, SIZE, model="brown", board="flat")
    images = {view.image: tmp_path / view.image for view in views}
    made = {s: np.clip(picture(s, rng), 0.0, 255.0).astype(np.uint8) for s in (0.0, 0.8, 1.0, 2.0)}
    files = {s: cv2.imencode(".png", image)[1].tobytes() for s, image in made.items()}

    def printed(*shifts_px: float) -> str:
        for path, shift_px in zip(images.values(), shifts_px, strict=True):
            path.write_bytes(files[shift_px])
        return str(interlaced(result, images))

    assert "every second line is of another moment" in printed(0.0, *[0.8] * 7) and "(3 of 4 images" in printed(
        0.0, *[1.0] * 7
    )
    assert printed(*[0.0] * 8) == printed(2.0, *[0.0] * 7) == "[]"
    printed(*[1.0] * 8)
    next(iter(images.values())).write_bytes(b"no image")
    assert "(3 of 3 images" in str(interlaced(result, images)) and interlaced(result, {}) == []
