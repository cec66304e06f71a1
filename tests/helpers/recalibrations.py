"""Captures of three perpendicular boards by cameras that are calibrated anew from noisy corners."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from helpers.calibration_scenes import SIZE, random_views
from helpers.reconstructions import BOARDS
from rigkit.calibration.assemble import assemble
from rigkit.calibration.solving.fit import fit_kept
from rigkit.calibration.solving.initialise import initialise
from rigkit.calibration.solving.solver import solve
from rigkit.calibration.views.observations import Observations
from rigkit.cameras.base import Camera
from rigkit.cameras.registry import MODELS
from rigkit.core.arrays import FloatArray
from rigkit.core.posetype import PoseType
from rigkit.synthetic.pairs import StereoScene, trihedral_pair

SIGMA_PX = 0.03
CALIBRATION_PX = 0.1
CALIBRATION_VIEWS = 15
LEVEL_DEG = 0.2
Calibrate = Callable[[], tuple[Camera, FloatArray]]


def random_scene(camera: Camera, pose_type: PoseType, rng: np.random.Generator) -> StereoScene:
    """Three perpendicular boards; the level holds as well as the pipeline takes it to hold."""
    return trihedral_pair(BOARDS, camera, pose_type, rng, level_sigma_deg=LEVEL_DEG, distance=(0.9, 1.3), walls=False)


def recalibration(camera: Camera, reach_deg: float, rng: np.random.Generator) -> Calibrate:
    """Return a source of calibrations of `camera`, each from the same views with new noise, and their covariances."""
    views, _, _ = random_views(camera, CALIBRATION_VIEWS, rng, reach_deg=reach_deg, noise_px=0.0)
    exact = Observations.from_views(views)
    start = solve(exact, next(initialise(exact, SIZE, MODELS[camera.model], None))).state

    def calibrate() -> tuple[Camera, FloatArray]:
        noisy = replace(exact, pixels=exact.pixels + CALIBRATION_PX * rng.normal(size=exact.pixels.shape))
        result = assemble(noisy, fit_kept(noisy, start, exact.present), None, (), ())
        return result.camera, result.covariance

    return calibrate
