"""Boards held in front of a lens whose calibration is checked."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache

import numpy as np

from helpers.calibration_scenes import BOARD, lens, noisy_view
from rigkit.calibration.calibrate import calibrate
from rigkit.calibration.result import Calibration
from rigkit.cameras.base import Camera
from rigkit.core.boards import Board
from rigkit.core.reach import Reach
from rigkit.geometry.rigid3 import Rigid3
from rigkit.planning import candidates
from rigkit.planning.goal import projection_goal
from rigkit.planning.information import CornerError, Knowledge
from rigkit.planning.plan import plan_views
from rigkit.validation.monitoring.evidence import FreshView, Monitored
from rigkit.validation.monitoring.verdict import CalibrationCheck, check_views
from rigkit.validation.monitoring.watch import monitored_camera

NOISE_PX = 0.03
CHANGED_PX = 0.25
"""Change of the projection, rms after the best rotation, that three views detect with certainty."""


def best_held(camera: Camera, board: Board, count: int, sigma_px: float, reach: Reach | None = None) -> list[Rigid3]:
    """Return the most informative poses of a board for a lens without a calibration."""
    known = Knowledge.guessed(camera, CornerError(sigma_px))
    plan = plan_views(known, [board], projection_goal(camera), count, reach=reach)
    return [view.cam_from_board for view in plan.views]


def poses_held(name: str, count: int, reach: Reach | None = None) -> list[Rigid3]:
    """Return the most informative poses of the board for a lens of `calibration_scenes`."""
    # Tests of some folders choose among fewer poses: theirs are not kept for the others.
    return _poses_held(name, count, reach, candidates.CANDIDATES_KEPT)


@cache
def _poses_held(name: str, count: int, reach: Reach | None, candidates_kept: int) -> list[Rigid3]:
    return best_held(lens(name), BOARD, count, NOISE_PX, reach)


def checked(calibration: Calibration, camera: Camera, rng: np.random.Generator) -> CalibrationCheck:
    poses = poses_held("reg", 3)
    views = [FreshView(f"{k}", 0, noisy_view(camera, pose, f"{k}", rng, NOISE_PX)) for k, pose in enumerate(poses)]
    return check_views(monitored_camera(calibration, "cam"), views)


def known_rig(mount: Rigid3, lens_sigmas: list[float], rotation_sigma_rad: float, freedom: float) -> Monitored:
    """Return a rig of two wide lenses, with the position of its second camera known to 0.01 mm."""
    camera = lens("wide")
    return Monitored(
        names=("left", "right"),
        cameras=(camera, camera),
        cam_from_rig=(Rigid3.identity(), mount),
        covariance=np.diag([*lens_sigmas, *lens_sigmas, *[rotation_sigma_rad] * 3, *[0.01] * 3]) ** 2,
        sigma_px=NOISE_PX,
        freedom=freedom,
    )


def scene_pixels(pose: Rigid3, count: int, noise_px: float, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Return the pixels in both cameras of such a rig of up to `count` points of a scene."""
    camera = lens("wide")
    rays, valid = camera.unproject(rng.uniform([100.0, 100.0], [1500.0, 1100.0], (count, 2)))
    points = rays[valid] * rng.uniform(700.0, 4000.0, (int(valid.sum()), 1))
    pixels1, seen1 = camera.project(points)
    pixels2, seen2 = camera.project(pose.apply(points))
    both = seen1 & seen2 & camera.on_image(pixels2)
    one, two = (p[both] + noise_px * rng.standard_normal((int(both.sum()), 2)) for p in (pixels1, pixels2))
    return one, two


def changed_lens(what: Callable[[np.ndarray], np.ndarray]) -> Camera:
    camera = lens("reg")
    step = what(camera.parameters.copy()) - camera.parameters
    size = np.sqrt(step @ projection_goal(camera).weight @ step)
    return camera.with_parameters(camera.parameters + step * CHANGED_PX / size)


def calibrated_lens() -> Calibration:
    """Return the calibration of the lens "reg" from 14 views of boards held in front of it."""
    camera, rng = lens("reg"), np.random.default_rng(2)
    views = [noisy_view(camera, pose, f"{k}", rng, NOISE_PX) for k, pose in enumerate(poses_held("reg", 14))]
    return calibrate(views, camera.size_px, model="brown", degree=5, board="flat")
