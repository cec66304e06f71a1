"""Power of the comparison: are lenses found that were changed between two halves?"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from halves.captures import Loaded, Views
from halves.comparing import calibrated, in_words, two_parts
from rigkit.calibration.certainty.uncertainty import projection_design
from rigkit.calibration.compare import CameraVerdict, compare_calibrations
from rigkit.calibration.result import Calibration
from rigkit.calibration.solving.clustered import drawn_errors
from rigkit.cameras.base import Camera
from rigkit.cameras.convert import refit_camera

ASKED_IMAGES, POWER_DRAWS = 20, 20
"""Images a side with which a touched lens is asked to be found, and pairs of such sessions drawn."""


def changed(views: Views, move: Callable[[np.ndarray], np.ndarray], size_px: tuple[int, int]) -> Views:
    """Return the views as another lens shows them: their corners moved."""
    limit = np.array(size_px) - 0.5
    moved = {}
    for name, own in views.items():
        moved[name] = [replace(view, pixels=np.clip(move(view.pixels), -0.5, limit)) for view in own]
    return moved


def shift_px(camera: Camera, pixels: np.ndarray, remaining_px: float) -> np.ndarray:
    """Return by how much the principal point must move for `remaining_px` rms to remain after the best rotation."""
    rays, valid = camera.unproject(pixels)
    along = np.array([1.0, 0.5])
    design = projection_design(camera, rays[valid])[:, -3:].transpose(2, 0, 1).reshape(-1, 3)
    all_moved = np.tile(along, int(valid.sum()))
    left = all_moved - design @ np.linalg.lstsq(design, all_moved, rcond=None)[0]
    return remaining_px / max(float(np.sqrt(2.0 * (left**2).mean())), 1e-9) * along


def power(name: str, loaded: Loaded, model: str) -> None:
    """Print the comparisons of one half with the other half behind a lens that was touched. Print how often it would be
    found with as many images a side as are asked of a user, of this camera and these boards: errors are drawn from what
    all images say that calibrations err by."""
    views, size = loaded
    a_views, b_views = two_parts(views, np.random.default_rng(0))
    a, whole = calibrated(a_views, size, model), calibrated(views, size, model)
    centre = a.camera.project(np.array([0.0, 0.0, 1.0]))[0]
    pixels = np.concatenate([view.pixels[view.kept] for view in a.views])
    shift = shift_px(a.camera, pixels[:: max(1, len(pixels) // 500)], 0.2)
    for what, move in (
        ("focal length + 0.1 %", lambda p: centre + 1.001 * (p - centre)),
        (f"principal point moved by {np.linalg.norm(shift):.1f} px", lambda p: p + shift),
    ):
        found = compare_calibrations(a, calibrated(changed(b_views, move, size), size, model))
        print(
            f"{in_words(f'{name} ({len(a_views)} images a side), {what}', found)}; with {ASKED_IMAGES} a side, drawn: "
            f"found {drawn_power(whole, move, len(views))} of {POWER_DRAWS} times",
            flush=True,
        )


def drawn_power(whole: Calibration, move: Callable[[np.ndarray], np.ndarray], images: int) -> int:
    """Return how often two calibrations from ASKED_IMAGES images each would be told apart, the second behind a lens
    that was touched: POWER_DRAWS pairs drawn from the covariance of one from so many `images`."""
    pixels = np.concatenate([view.pixels[view.kept] for view in whole.views])
    rays, valid = whole.camera.unproject(pixels)
    cameras = whole.camera, refit_camera(whole.camera, rays[valid], move(pixels[valid]))
    covariance, rng = whole.covariance * images / ASKED_IMAGES, np.random.default_rng(0)
    errors = drawn_errors(covariance, np.inf, rng).T
    found = 0
    for k in range(POWER_DRAWS):
        a, b = (
            replace(
                whole,
                camera=camera.with_parameters(camera.parameters + errors[2 * k + side]),
                covariance=covariance,
                freedom=float(ASKED_IMAGES - 1),
            )
            for side, camera in enumerate(cameras)
        )
        found += compare_calibrations(a, b).verdict is CameraVerdict.OTHER
    return found
