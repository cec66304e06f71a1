"""A rig of three cameras with mixed lenses, and frames of boards that they see."""

from __future__ import annotations

from functools import cache

import numpy as np

from helpers.calibration_scenes import BOARD, lens
from rigkit.calibration.rig.calibrate import calibrate_rig
from rigkit.calibration.rig.result import RigCalibration
from rigkit.cameras.base import Camera
from rigkit.core.detections import BoardView
from rigkit.geometry.rigid3 import Rigid3
from rigkit.geometry.rotation import exp_so3

NOISE_PX = 0.2
SIGMAS = 4.0
"""A mount further than this from the truth, in its own standard deviations, is wrong: 1 in 16000 by chance."""
MODELS = {"reg": "brown", "wide": "kannala_brandt", "fish": "kannala_brandt"}

Views = dict[str, list[tuple[str, BoardView]]]


def mounts() -> dict[str, tuple[Camera, Rigid3]]:
    turned = exp_so3(np.array([0.02, -0.1, 0.3]))
    return {
        "reg": (lens("reg"), Rigid3.identity()),
        "wide": (lens("wide"), Rigid3(turned, [-120.0, 15.0, 5.0])),
        "fish": (lens("fish"), Rigid3(turned.T, [140.0, -20.0, 30.0])),
    }


def rig_views(
    rng: np.random.Generator, frames: int, *, chain: bool = False, bumps_mm: np.ndarray | float = 0.0
) -> Views:
    """Return frames seen by all cameras that have the board in view; with `chain` never by the first and last together.

    `bumps_mm` (54, 3) is the deviation of the corners from the board's nominal shape.
    """
    views: Views = {name: [] for name in mounts()}
    k = 0
    for _ in range(2000):
        if k == frames:
            break
        rotation = exp_so3(rng.normal(size=3) * np.array([0.45, 0.45, 1.5]))
        middle = rotation @ BOARD.points().mean(axis=0)
        rig_from_board = Rigid3(
            rotation, np.array([rng.uniform(-160, 160), rng.uniform(-110, 110), rng.uniform(350, 700)]) - middle
        )
        seen = {}
        for name, (camera, cam_from_rig) in mounts().items():
            pixels, valid = camera.project((cam_from_rig @ rig_from_board).apply(BOARD.points() + bumps_mm))
            if valid.all() and camera.on_image(pixels).all():
                noisy = np.clip(pixels + NOISE_PX * rng.normal(size=pixels.shape), 0.0, np.array(camera.size_px) - 1.0)
                seen[name] = BoardView(f"{name}{k}.png", BOARD, BOARD.grid(), noisy, np.full(54, NOISE_PX))
        if len(seen) < 2:
            continue
        if chain:
            seen.pop("reg" if k % 2 else "fish", None)
        for name, view in seen.items():
            views[name].append((f"{k:03d}", view))
        k += 1
    assert k == frames
    return views


def sizes() -> dict[str, tuple[int, int]]:
    return {name: camera.size_px for name, (camera, _) in mounts().items()}


@cache
def calibrated_rig() -> RigCalibration:
    """Return the calibration of the rig from 8 frames, without held-out errors."""
    return calibrate_rig(rig_views(np.random.default_rng(1), 8), sizes(), model=MODELS, folds=0)
