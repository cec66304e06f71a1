"""REAL public captures and the exact laboratory: calibrated without a guess, against their known values."""

from __future__ import annotations

import json
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from helpers.data import shared_data
from truth.cameras import published_corners

from rigkit.calibration.calibrate import calibrate
from rigkit.calibration.result import Calibration
from rigkit.calibration.rig.calibrate import calibrate_rig
from rigkit.calibration.solving.poses import find_poses, refine_poses
from rigkit.calibration.solving.state import State, evaluate
from rigkit.calibration.views.observations import Observations
from rigkit.calibration.views.usable import views_of_image
from rigkit.cameras.base import Camera
from rigkit.core.arrays import FloatArray
from rigkit.core.boards import Board
from rigkit.core.detections import BoardView
from rigkit.detection.detect import detect_boards
from rigkit.geometry.rotation import exp_so3
from rigkit.io.media.images import read_image

pytestmark = pytest.mark.real

LAB_DIFFERENCE_PX = 0.03
"""Projection against the exact lens over the part of the image that boards covered, after the best rotation, RMS."""
PLANE_WARP_PX, PLANE_RELEASED_PX = 0.40, 0.22
HELDOUT_REL = 0.1
"""What is said of other pictures holds for those of a test split, but for corners left out."""
FISHEYE1_PX = 0.413
"""Held-out RMS of the best rivals on these captures."""
BASELINE_MM = (99.81, 0.25)
BOUGUET_FX = 533.5


@cache
def detected(folder: Path, pattern: str, board: Board) -> tuple[list[BoardView], tuple[int, int]]:
    views: list[BoardView] = []
    size = (0, 0)
    for path in sorted(folder.glob(pattern)):
        image = read_image(path)
        size = (image.shape[1], image.shape[0])
        views += views_of_image(path.name, detect_boards(image, [board]), [board])[0]
    return views, size


@pytest.mark.parametrize("name", ["fisheye", "regular"])
def test_lab_lens_from_images(name: str) -> None:
    folder = shared_data(f"lab-a/calibration/{name}")
    truth = json.loads((folder / "truth.json").read_text())["lens_truth"]
    views, size = detected(folder, "*.jpg", Board("a9x6_30", 9, 6, 30.0, 30.0))
    assert len(views) == 20
    result = calibrate(views, size)
    assert result.dropped == ()
    assert _rms_against(result, truth, views) < LAB_DIFFERENCE_PX


def _rms_against(result: Calibration, truth: dict[str, list[float]], views: list[BoardView]) -> float:
    """Return the RMS difference at the corners and halfway between neighbours, after the best rotation."""
    pixels = np.concatenate([0.5 * (v.pixels[1:] + v.pixels[:-1]) for v in views] + [v.pixels for v in views])
    rays = _true_rays(pixels, truth)
    rotation = np.eye(3)
    for _ in range(6):
        turned = rays @ rotation.T
        projected, seen, d_pixels_d_point, _ = result.camera.project_with_jacobians(turned)
        assert seen.all()
        design = np.cross(turned[:, None, :], d_pixels_d_point).reshape(-1, 3)
        rotation = exp_so3(np.linalg.lstsq(design, (pixels - projected).reshape(-1), rcond=None)[0]) @ rotation
    difference = result.camera.project(rays @ rotation.T)[0] - pixels
    return float(np.sqrt((difference**2).sum(axis=1).mean()))


def _true_rays(pixels: FloatArray, truth: dict[str, list[float]]) -> FloatArray:
    offset = (pixels - np.array(truth["centre_px"])) * truth["pixel_mm"]
    r = np.linalg.norm(offset, axis=1)
    theta = sum(k * r ** (i + 1) for i, k in enumerate(truth["k"]))
    return np.column_stack([offset * (np.sin(theta) / r)[:, None], np.cos(theta)])


def plane_views(part: str) -> list[BoardView]:
    folder = shared_data(f"real/ov-plane/corners/{part}")
    board = Board("ov", 22, 22, 7.5, 7.5)
    return [published_corners(path, board) for path in sorted(folder.glob("*.orpc"))]


# Whether the pupil moves is decided in nearly half of the time.
@pytest.mark.parametrize("pupil", ["central", pytest.param("auto", marks=pytest.mark.thorough)])
@pytest.mark.parametrize(
    ("shape", "limit"),
    [("warp", PLANE_WARP_PX), pytest.param("released", PLANE_RELEASED_PX, marks=pytest.mark.thorough)],
)
def test_plane_with_published_corners(shape: str, limit: float, pupil: str) -> None:
    result = calibrate(plane_views("train"), (1280, 800), model="kannala_brandt", board=shape, pupil=pupil)
    assert len(result.views) == 18 and result.dropped == ()
    # The published test split, every corner of it: only the poses of its views are fitted.
    others = _rms_of_other_views(result, plane_views("test"))
    assert others < limit
    assert result.heldout_rms_px == pytest.approx(others, rel=HELDOUT_REL)
    assert len(result.outliers) < 0.02 * result.corner_count


def _rms_of_other_views(result: Calibration, views: list[BoardView]) -> float:
    observations = Observations.from_views(views)
    ahead = np.tile([0.0, 0.0, 100.0], (len(views), 1))
    state = State.start(result.near, np.tile(np.eye(3), (len(views), 1, 1)), ahead, observations)
    state = replace(state, shape=replace(state.shape, flat=result.boards[0].points_mm))
    state = find_poses(observations, state, observations.weight, 0.5)
    state, _ = refine_poses(observations, state, observations.weight)
    residuals = evaluate(state, observations)
    assert residuals.valid[observations.present].all()
    return float(np.sqrt((residuals.px**2).sum(axis=-1)[observations.present].mean()))


def test_fisheye1_from_images() -> None:
    views, size = detected(shared_data("real/ocam-fisheye1"), "*.jpg", Board("b", 8, 6, 32.5, 32.5))
    assert len({v.image for v in views}) == 15
    result = calibrate(views, size, model="kannala_brandt")
    assert result.heldout_rms_px is not None and result.heldout_rms_px < FISHEYE1_PX
    assert np.abs(_centre(result.camera) - [543.99, 377.65]).max() < 2.0
    # The sheet's white margin is 0.80 squares wide on one side and 0.95 on the other: these three show it turned.
    other = {r.image for r, v in zip(result.views, views, strict=True) if (r.grid != v.grid).any()}
    turned = {"Fisheye1_1.jpg", "Fisheye1_2.jpg", "Fisheye1_7.jpg"}
    assert other in (turned, {v.image for v in views} - turned)


def test_camodocal_fisheye_uses_every_image() -> None:
    views, size = detected(shared_data("real/camodocal-fisheye"), "*.png", Board("b", 9, 6, 30.0, 30.0))
    result = calibrate(views, size, model="kannala_brandt", board="flat")
    assert len(result.views) == 20 and result.dropped == ()
    assert abs(result.camera.parameters[0] - 383.6) < 2.0
    assert np.abs(_centre(result.camera) - [638.4, 477.6]).max() < 2.0


@pytest.mark.thorough
def test_stereo_baseline() -> None:
    """The quick run holds the same of the same images by the command line (test_rig_session.py)."""
    folder, board = shared_data("real/bouguet-stereo"), Board("b", 9, 6, 30.0, 30.0)
    left, size = detected(folder, "left*.jpg", board)
    right, _ = detected(folder, "right*.jpg", board)
    framed = {
        "left": [(v.image[-6:-4], v) for v in left],
        "right": [(v.image[-6:-4], replace(v, image=v.image)) for v in right],
    }
    rig = calibrate_rig(framed, {"left": size, "right": size}, model="brown")
    length, sigma = rig.baseline_mm("left", "right")
    assert abs(length - BASELINE_MM[0]) < BASELINE_MM[1]
    assert 0.0 < sigma < 0.2
    for camera, focal, centre in zip(rig.cameras, (533.5, 536.7), ([341.6, 235.2], [326.3, 250.1]), strict=True):
        assert np.abs(camera.camera.parameters[:2] - focal).max() < 2.0
        assert np.abs(_centre(camera.camera) - centre).max() < 5.0


def _centre(camera: Camera) -> FloatArray:
    return camera.project(np.array([0.0, 0.0, 1.0]))[0]


@pytest.mark.thorough
def test_pixels_twice_as_wide_as_high() -> None:
    """As single fields of interlaced images have them. The other models, fitted to boards as one found them, strayed to
    other lenses there, and the right one was refused as open."""
    views, (width, height) = detected(shared_data("real/bouguet-stereo"), "left*.jpg", Board("b", 9, 6, 30.0, 30.0))
    squeezed = [replace(view, pixels=(view.pixels + 0.5) * [1.0, 0.5] - 0.5) for view in views[::2]]
    result = calibrate(squeezed, (width, height // 2), model="auto")
    focal = dict(zip(result.camera.parameter_names(), result.camera.parameters, strict=True))
    assert focal["fx"] / focal["fy"] == pytest.approx(2.0, abs=0.004)
    assert focal["fx"] == pytest.approx(BOUGUET_FX, abs=2.0)
