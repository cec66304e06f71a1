"""Sessions of one camera: boards at given poses, and images whose corners err in common."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from helpers.calibration_scenes import BOARD, REACH_DEG, SIZE, lens, random_views
from rigkit.calibration.calibrate import calibrate
from rigkit.calibration.result import Calibration
from rigkit.cameras.base import Camera
from rigkit.core.arrays import FloatArray
from rigkit.core.detections import BoardView
from rigkit.geometry.rotation import exp_so3

NOISE_PX = 0.1
"""Of corners in views at given poses."""
CORNERS_PX, IMAGES_PX = 0.05, 0.15
"""Of corners on their own, and of the smooth field that all corners of an image share."""
GOOD_PX, FAIR_PX = 0.03, 0.05
"""Errors in common of a good image, and of one with which a thousandth of a focal length is not found any more."""


def disturbed(views: list[BoardView], rng: np.random.Generator, images_px: float) -> list[BoardView]:
    """Return the views with noise of every corner and, of every image, a smooth displacement field of its own."""
    x, y = (BOARD.grid() / (np.array(BOARD.size) - 1.0) * 2.0 - 1.0).T
    fields = np.stack([x * x, x * y, y * y, x * x * y, x * y * y], axis=-1)
    out = []
    for view in views:
        own = images_px * fields @ rng.normal(size=(fields.shape[1], 2))
        out.append(replace(view, pixels=view.pixels + own + CORNERS_PX * rng.normal(size=view.pixels.shape)))
    return out


def sessions(name: str, images_px: float, count: int) -> list[Calibration]:
    """Return calibrations of a lens from sessions of 20 images each."""
    rng = np.random.default_rng(3)
    camera = lens(name)
    views = [
        disturbed(random_views(camera, 20, rng, reach_deg=REACH_DEG[name], noise_px=0.0)[0], rng, images_px)
        for _ in range(count)
    ]
    return [calibrate(own, camera.size_px, model=camera.model, board="flat") for own in views]


def longer(calibration: Calibration) -> Calibration:
    """Return a calibration whose focal length is longer by a thousandth."""
    parameters = np.array(calibration.camera.parameters)
    parameters[:2] *= 1.001
    return replace(calibration, camera=calibration.camera.with_parameters(parameters))


def seen(camera: Camera, rotation: FloatArray, translation_mm: FloatArray, rng: np.random.Generator) -> list[BoardView]:
    """Return the views of boards at poses (V, 3, 3) and (V, 3), of those that the image holds."""
    out = []
    for k, (turn, shift) in enumerate(zip(rotation, translation_mm, strict=True)):
        pixels, valid = camera.project(BOARD.points() @ turn.T + shift)
        if valid.all() and camera.on_image(pixels).all():
            noisy = np.clip(pixels + NOISE_PX * rng.normal(size=pixels.shape), -0.5, np.array(SIZE) - 0.5)
            out.append(BoardView(f"{k:03d}.png", BOARD, BOARD.grid(), noisy, np.full(len(noisy), NOISE_PX)))
    return out


def poses(rng: np.random.Generator, count: int, about: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return poses all over the image, turned by the rotation vectors `about` (count, 3)."""
    depth = rng.uniform(500.0, 1000.0, count)
    place = np.stack([0.45 * depth * rng.uniform(-1, 1, count), 0.33 * depth * rng.uniform(-1, 1, count), depth], -1)
    rotation = exp_so3(about)
    return rotation, place - rotation @ BOARD.points().mean(axis=0)
