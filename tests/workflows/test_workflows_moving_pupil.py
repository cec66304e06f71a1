"""Calibrations with a moving pupil: their file, and the workflows that use the pupil or report its neglect."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.calibration_scenes import SIZE, lens, random_views
from helpers.schemas import faults

from rigkit.calibration.calibrate import calibrate
from rigkit.calibration.result import Calibration
from rigkit.cameras.base import Camera
from rigkit.cameras.moving_pupil import NearCamera, pupil_shift_of_rays_mm
from rigkit.core.arrays import Pixels, Points
from rigkit.core.boards import Board
from rigkit.core.detections import BoardView
from rigkit.core.errors import InputError
from rigkit.core.measurement_task import Quantity, Task
from rigkit.io.calibrations.calibration_file import calibration_text, load_calibration, load_camera, save_calibration
from rigkit.validation.certificate.propagation import measured_points
from rigkit.validation.monitoring.evidence import FreshView
from rigkit.validation.monitoring.verdict import check_views
from rigkit.workflows.checks.certify import certify_file
from rigkit.workflows.checks.check import fixed_text, load_monitored
from rigkit.workflows.checks.diff import CameraPair, diff
from rigkit.workflows.handeye import _with_fixed_pupil
from rigkit.workflows.inputs.camera_files import import_camera, import_near_camera
from rigkit.workflows.options.cameras import ExportCameraOptions
from rigkit.workflows.outputs.export_camera import export_camera

NEAR = Board("near", 9, 6, 12.0, 12.0)
TRUE = NearCamera.of(lens("fish"), (2.0, 0.3))
LEFT_OUT = "entrance pupil of this lens moves"


def views_of(seed: int, count: int = 14) -> list[BoardView]:
    rng = np.random.default_rng(seed)
    return random_views(TRUE, count, rng, reach_deg=80.0, board=NEAR, noise_px=0.03)[0]


@pytest.fixture(scope="module")
def moving() -> Calibration:
    return calibrate(views_of(0), SIZE, model="kannala_brandt", board="flat", folds=0)


@pytest.fixture(scope="module")
def saved(moving: Calibration, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("pupil") / "calibration.json"
    save_calibration(path, moving)
    return path


def test_the_file_holds_the_pupil(moving: Calibration, saved: Path) -> None:
    assert moving.pupil is not None
    back = load_calibration(saved)
    assert back.pupil is not None
    for name in ("terms", "covariance", "with_frame"):
        np.testing.assert_array_equal(getattr(back.pupil, name), getattr(moving.pupil, name))
    assert (load_camera(saved).parameters == moving.camera.parameters).all()
    assert not faults(json.loads(saved.read_text(encoding="utf-8")))
    assert back.verdicts == moving.verdicts


def test_without_a_pupil_the_file_says_nothing_of_one(tmp_path: Path) -> None:
    central = calibrate(views_of(0), SIZE, model="kannala_brandt", board="flat", folds=0, pupil="central")
    assert '"pupil"' not in calibration_text(central)
    path = tmp_path / "central.json"
    save_calibration(path, central)
    assert load_calibration(path).pupil is None


def _without_rows(data: dict[str, Any]) -> None:
    data["pupil"]["with_frame"] = data["pupil"]["with_frame"][:-1]


def _other_key(data: dict[str, Any]) -> None:
    data["pupil"]["mm"] = 1.0


def _negative(data: dict[str, Any]) -> None:
    data["pupil"]["covariance"] = [[-1.0, 0.0], [0.0, 1.0]]


def _text(data: dict[str, Any]) -> None:
    data["pupil"]["mm_per_rad2"] = "2"


@pytest.mark.parametrize("spoil", [_without_rows, _other_key, _negative, _text])
def test_a_damaged_pupil_is_named(spoil: Callable[[dict[str, Any]], None], saved: Path, tmp_path: Path) -> None:
    data = json.loads(saved.read_text(encoding="utf-8"))
    spoil(data)
    path = tmp_path / "spoilt.json"
    path.write_text(json.dumps(data), encoding="utf-8")
    with pytest.raises(InputError, match=r"spoilt\.json.*damaged.*calibrate again"):
        load_calibration(path)


def test_a_central_approximation_is_reported(saved: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    assert import_camera(saved).model == "kannala_brandt"
    assert LEFT_OUT in caplog.text and "rays are off by up to" in caplog.text
    caplog.clear()
    assert isinstance(import_near_camera(saved), NearCamera) and LEFT_OUT not in caplog.text
    export_camera(saved, ExportCameraOptions(output=tmp_path / "camera.yaml", kind="opencv"))
    assert LEFT_OUT in caplog.text


def test_a_certificate_is_of_the_lens_with_its_pupil(saved: Path) -> None:
    """Lengths near the camera are within the bound, which as a central camera they are not."""
    task = Task(quantity=Quantity.LENGTH, size_mm=30.0, distance_mm=150.0)
    found = certify_file(saved, task).certificate
    assert not any(LEFT_OUT in finding.message for finding in found.findings)
    (camera,) = found.instrument.cameras
    assert isinstance(camera, NearCamera) and len(found.instrument.covariance) == camera.parameters.size
    places = found.pixels[found.in_view]
    points, _ = measured_points(camera.unproject(places)[0], task, is_rig=False)
    # Of what is seen the first two are the ends of a level length.
    ends = points[:, :2].reshape(-1, 3)
    seen, bound = TRUE.project(ends)[0], found.bound[found.in_view]
    off = {}
    for name, one in (("near", camera), ("central", camera.lens)):
        moved = at_their_distance(one, seen, ends).reshape(-1, 2, 3)
        off[name] = np.abs(np.linalg.norm(moved[:, 1] - moved[:, 0], axis=1) - task.size_mm)
    assert np.mean(off["near"] <= bound) > 0.9 > 0.5 > np.mean(off["central"] <= bound)


def at_their_distance(camera: Camera, pixels: Pixels, points: Points) -> Points:
    """Return where on the rays of pixels points as far away as these lie."""
    rays = camera.unproject(pixels)[0]
    starts = np.zeros_like(rays)
    if isinstance(camera, NearCamera):
        starts[:, 2] = pupil_shift_of_rays_mm(rays, camera.pupil)
    ahead = np.sum(rays * starts, axis=1)
    along = np.sqrt(ahead**2 + np.sum(points**2, axis=1) - np.sum(starts**2, axis=1)) - ahead
    return starts + along[:, None] * rays


def test_diff_compares_far_points(saved: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    other, central = tmp_path / "other.json", tmp_path / "central.json"
    save_calibration(other, calibrate(views_of(1), SIZE, model="kannala_brandt", board="flat", folds=0))
    same = diff(saved, other)
    assert isinstance(same, CameraPair) and same.same and LEFT_OUT not in caplog.text
    views = views_of(1)
    save_calibration(central, calibrate(views, SIZE, model="kannala_brandt", board="flat", folds=0, pupil="central"))
    diff(saved, central)
    assert "'" + str(central) + "' was calibrated without" in caplog.text


def test_fresh_boards_are_checked_with_the_pupil(saved: Path) -> None:
    monitored, _ = load_monitored(saved)
    seen = [FreshView(f"{k}", 0, view) for k, view in enumerate(views_of(2, 6))]
    assert check_views(monitored, seen).rms_px < 0.06
    near = monitored.cameras[0]
    assert isinstance(near, NearCamera)
    # As a central camera; and the lens and the pupil as sure together as they were solved for, but for the noise that
    # departures of the lens explain.
    central = replace(monitored, cameras=(near.with_parameters([*near.lens.parameters, 0.0, 0.0]),))
    assert check_views(central, seen).rms_px > 0.2
    own, known = slice(near.lens.parameters.size, None), load_calibration(saved)
    assert known.pupil is not None
    assert (np.diag(monitored.covariance[own, own]) >= 0.98 * np.diag(known.pupil.covariance)).all()
    # What the lens may do beyond its model adds to both.
    np.testing.assert_allclose(monitored.covariance[:2, own], known.pupil.with_frame[:2], rtol=0.1)


def test_an_uncertain_pupil_raises_no_alarm(saved: Path) -> None:
    """What fresh views see of it is no change of the lens, where the calibration is as unsure."""
    monitored, _ = load_monitored(saved)
    near, p = monitored.cameras[0], monitored.cameras[0].parameters.size
    sigma = 0.3
    unsure = monitored.covariance.copy()
    unsure[p - 2, p - 2] += sigma**2
    off = near.with_parameters(near.parameters + np.where(np.arange(p) == p - 2, 1.5 * sigma, 0.0))
    views = random_views(off, 6, np.random.default_rng(4), reach_deg=80.0, board=NEAR, noise_px=0.03)[0]
    seen = [FreshView(f"{k}", 0, view) for k, view in enumerate(views)]
    assert not check_views(monitored, seen).holds
    assert check_views(replace(monitored, covariance=unsure), seen).holds


def test_a_corrected_file_keeps_a_pupil_that_goes_with_it(saved: Path, tmp_path: Path) -> None:
    """Surer of the lens, it is surer of the pupil, and of both together."""
    monitored, _ = load_monitored(saved)
    zoomed = monitored.cameras[0].parameters.copy()
    zoomed[:2] *= 1.01
    changed = monitored.cameras[0].with_parameters(zoomed)
    assert isinstance(changed, NearCamera)
    views = random_views(changed, 12, np.random.default_rng(4), reach_deg=80.0, board=NEAR, noise_px=0.03)[0]
    check = check_views(monitored, [FreshView(f"{k}", 0, v) for k, v in enumerate(views)])
    assert not check.holds and check.change is not None
    path = tmp_path / "fixed.json"
    path.write_text(fixed_text(saved, check), encoding="utf-8")
    before, after = load_calibration(saved), load_calibration(path)
    assert before.pupil is not None and after.pupil is not None
    assert abs(after.camera.focal_px / before.camera.focal_px - 1.01) < 3e-3
    joint = after.near_covariance
    scale = np.sqrt(np.diag(joint))
    assert np.linalg.eigvalsh(joint / np.outer(scale, scale)).min() > -1e-9
    p = after.camera.parameters.size
    np.testing.assert_allclose(joint[:p, :p], after.covariance, rtol=1e-6)


def test_a_pose_corrects_for_the_pupil(saved: Path) -> None:
    view, near = views_of(3, 1)[0], import_near_camera(saved)
    fixed_pupil = _with_fixed_pupil(near, view)
    assert np.abs(fixed_pupil.pixels - view.pixels).max() > 1.0
    assert _with_fixed_pupil(import_camera(saved), view) is view
