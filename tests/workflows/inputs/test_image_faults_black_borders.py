"""Images that were undistorted with black borders left in are recognised, image circles and bars are not."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from helpers.calibration_scenes import random_views

from rigkit.calibration.calibrate import calibrate
from rigkit.cameras.brown import Brown
from rigkit.io.media.images import Image
from rigkit.workflows.inputs.image_faults import black_borders

SIZE = (640, 480)
CAMERA = Brown(SIZE, np.array([540.0, 540.0, 320.0, 240.0, -0.2, 0.1, 0.0, 0.0, 0.0]))
OTHER = np.array([[500.0, 0.0, 330.0], [0.0, 500.0, 232.0], [0.0, 0.0, 1.0]])
OTHER_TERMS = np.array([-0.28, 0.08, 0.0, 0.0, 0.0])


def undistorted(image: Image, keep_all: float) -> Image:
    camera, _ = cv2.getOptimalNewCameraMatrix(OTHER, OTHER_TERMS, SIZE, keep_all)
    return np.asarray(cv2.undistort(image, OTHER, OTHER_TERMS, None, camera), dtype=np.uint8)


def in_circle(image: Image) -> Image:
    y, x = np.indices(image.shape)
    return np.asarray(np.where(np.hypot(x - 320.0, y - 240.0) < 310.0, image, 0), dtype=np.uint8)


def with_bars(image: Image) -> Image:
    return np.asarray(np.where((np.indices(image.shape)[1] - 319.5) ** 2 < 290.0**2, image, 0), dtype=np.uint8)


def behind_a_rail(image: Image) -> Image:
    """Return the image with something black at half of opposite sides."""
    y, x = np.indices(image.shape)
    return np.asarray(np.where((abs(x - 319.5) > 300.0) & (abs(y - 239.5) < 120.0), 0, image), dtype=np.uint8)


def twelve_bits(image: Image) -> Image:
    return (image.astype(np.uint16) << 4).astype(np.uint16)


def dim_sides(image: Image) -> Image:
    """Return the image with sides that bulge as black ones do, at a quarter of the brightness."""
    white = np.full_like(image, 255)
    return np.asarray(np.where(undistorted(white, 1.0) == 255, image, image // 4), dtype=np.uint8)


@pytest.mark.parametrize(
    ("change", "reported"),
    [
        (lambda image: undistorted(image, 1.0), True),
        (lambda image: undistorted(image, 0.0), False),
        (lambda image: image, False),
        (in_circle, False),
        (with_bars, False),
        (behind_a_rail, False),
        (lambda image: twelve_bits(undistorted(image, 1.0)), True),
        (lambda image: twelve_bits(dim_sides(image)), False),
    ],
    ids=["kept whole", "cropped", "as they are", "image circle", "bars", "rail", "12 bits", "12 bits, dim sides"],
)
def test_black_borders_of_undistorted_images_are_named(
    change: Callable[[Image], Image], reported: bool, tmp_path: Path, rng: np.random.Generator
) -> None:
    views, _, _ = random_views(CAMERA, 8, rng, reach_deg=25.0)
    result = calibrate(views, SIZE, model="brown", board="flat", folds=0)
    images = {view.image: tmp_path / view.image for view in result.views}
    for path in images.values():
        picture = rng.integers(60, 200, size=SIZE[::-1]).astype(np.uint8)
        changed = change(picture)
        jpeg = changed.dtype == np.uint8
        data = cv2.imencode(*((".jpg", changed, [cv2.IMWRITE_JPEG_QUALITY, 90]) if jpeg else (".png", changed)))[1]
        path.write_bytes(data.tobytes())
    found = black_borders(result, images)
    assert [("black bulges into the images" in str(finding)) for finding in found] == [True] * reported
    for path in list(images.values())[1:]:
        path.unlink()
    assert black_borders(result, images) == black_borders(result, {}) == []
