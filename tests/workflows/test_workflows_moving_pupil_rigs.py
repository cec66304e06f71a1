"""Rigs of lenses with moving pupils: joint solution, file, and the workflows that use it."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from helpers.calibration_scenes import SIZE, lens
from helpers.schemas import faults

from rigkit.calibration.board_shape import BoardShape
from rigkit.calibration.certainty.uncertainty import FarProjection
from rigkit.calibration.result import Calibration
from rigkit.calibration.rig.calibrate import calibrate_rig
from rigkit.calibration.rig.result import RigCalibration
from rigkit.cameras.moving_pupil import NearCamera
from rigkit.core.boards import Board
from rigkit.core.detections import BoardView
from rigkit.core.errors import InputError
from rigkit.core.measurement_task import Quantity, Task
from rigkit.geometry.rigid3 import Rigid3
from rigkit.geometry.rotation import exp_so3
from rigkit.io.calibrations.rig_file import load_saved_rig, rig_text
from rigkit.validation.certificate.propagation import measured_points
from rigkit.validation.monitoring.change_aim import informative_views
from rigkit.validation.monitoring.evidence import FreshView
from rigkit.validation.monitoring.verdict import check_views
from rigkit.validation.monitoring.watch import monitored_rig
from rigkit.workflows.calibration.next_pictures import next_frames
from rigkit.workflows.checks.certify import certify_file
from rigkit.workflows.checks.check import load_monitored
from rigkit.workflows.inputs.camera_files import import_pair

BOARD = Board("near", 9, 6, 12.0, 12.0)
NOISE_PX = 0.03
MOUNT = Rigid3(exp_so3(np.array([0.02, -0.05, 0.03])), [-60.0, 2.0, 3.0])
CAMERAS = {
    "left": (NearCamera.of(lens("fish"), (3.0, -0.3)), Rigid3.identity()),
    "right": (NearCamera.of(lens("fish"), (2.0, -0.2)), MOUNT),
}


def frames(count: int, seed: int) -> dict[str, list[tuple[str, BoardView]]]:
    """Return frames of boards 100 to 220 mm away, each seen by one camera or both."""
    rng, points = np.random.default_rng(seed), BOARD.points()
    views: dict[str, list[tuple[str, BoardView]]] = {name: [] for name in CAMERAS}
    while (k := len({frame for own in views.values() for frame, _ in own})) < count:
        angle, about = np.radians(70.0) * np.sqrt(rng.random()), rng.uniform(-np.pi, np.pi)
        facing = exp_so3(angle * np.array([-np.sin(about), np.cos(about), 0.0]))
        rotation = facing @ exp_so3(rng.normal(size=3) * [0.4, 0.4, 1.5])
        rig_from_board = Rigid3(rotation, rng.uniform(100.0, 220.0) * facing[:, 2] - rotation @ points.mean(axis=0))
        for name, (camera, cam_from_rig) in CAMERAS.items():
            pixels, valid = camera.project((cam_from_rig @ rig_from_board).apply(points))
            if valid.all() and camera.lens.on_image(pixels).all():
                noisy = np.clip(pixels + NOISE_PX * rng.normal(size=pixels.shape), 0.0, np.array(SIZE) - 1.0)
                view = BoardView(f"{name}{k}.png", BOARD, BOARD.grid(), noisy, np.full(len(points), NOISE_PX))
                views[name].append((f"{k:03d}", view))
    return views


@pytest.fixture(scope="module")
def rig() -> RigCalibration:
    return calibrate_rig(frames(14, 0), dict.fromkeys(CAMERAS, SIZE), model="kannala_brandt", folds=0)


@pytest.fixture(scope="module")
def saved(rig: RigCalibration, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("rig") / "rig.json"
    path.write_text(rig_text(rig), encoding="utf-8")
    return path


def test_pupils_are_solved_for_with_the_mounts(rig: RigCalibration) -> None:
    length, sigma = rig.baseline_mm("left", "right")
    true = float(np.linalg.norm(MOUNT.translation_mm))
    assert abs(length - true) < 3.0 * sigma < 0.1
    for found, (camera, _) in zip(rig.cameras, CAMERAS.values(), strict=True):
        pupil = found.calibration.pupil
        assert pupil is not None
        off = (pupil.terms - camera.pupil) / np.sqrt(np.diag(pupil.covariance))
        assert (np.abs(off) < 3.5).all()
        assert any(f"camera '{found.name}': the lens is not central" in str(v) for v in rig.verdicts)
    assert rig.rms_px < 1.5 * np.sqrt(2.0) * NOISE_PX
    assert len(rig.covariance) == 2 * rig.cameras[0].camera.parameters.size + 6


def test_central_cameras_have_a_wrong_baseline() -> None:
    central = calibrate_rig(
        frames(14, 0), dict.fromkeys(CAMERAS, SIZE), model="kannala_brandt", folds=0, pupil="central"
    )
    length, _ = central.baseline_mm("left", "right")
    assert abs(length - float(np.linalg.norm(MOUNT.translation_mm))) > 0.1 and central.rms_px > 0.1
    assert all(camera.calibration.pupil is None for camera in central.cameras)


def test_a_camera_whose_images_tell_less_has_one_where_another_does(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[Calibration] = []

    def of_the_first(calibration: Calibration, far: FarProjection) -> bool:
        asked.append(calibration)
        return len(asked) == 1

    monkeypatch.setattr("rigkit.calibration.calibrate.may_move", of_the_first)
    rig = calibrate_rig(frames(14, 0), dict.fromkeys(CAMERAS, SIZE), model="kannala_brandt", folds=0)
    assert len(asked) == 2 and set(rig.pupils) == set(CAMERAS)


def test_the_file_holds_the_pupils(rig: RigCalibration, saved: Path) -> None:
    assert not faults(json.loads(saved.read_text(encoding="utf-8")))
    known = load_saved_rig(saved)
    for camera in rig.cameras:
        assert camera.calibration.pupil is not None
        np.testing.assert_array_equal(known.pupils[camera.name].terms, camera.calibration.pupil.terms)
        assert known.pupils[camera.name].with_frame.shape == (len(rig.covariance), 2)


def test_the_file_holds_the_shapes_of_boards(rig: RigCalibration, tmp_path: Path) -> None:
    first, path = rig.cameras[0], tmp_path / "rig.json"
    declared = first.calibration.boards[0].declared
    assert declared is not None
    bent = declared.points() + np.linspace(0.0, 0.3, declared.corner_count)[:, None] ** 2
    solved = replace(first.calibration, boards=(BoardShape.of(declared, "released", bent),))
    text = rig_text(replace(rig, cameras=(replace(first, calibration=solved), *rig.cameras[1:])))
    path.write_text(text, encoding="utf-8")
    assert not faults(json.loads(text))
    known, boards = load_monitored(path)
    np.testing.assert_array_equal(known.boards_mm[declared.board_id], bent)
    assert [board.board_id for board in boards] == [declared.board_id]


def test_a_damaged_pupil_is_named(saved: Path, tmp_path: Path) -> None:
    data = json.loads(saved.read_text(encoding="utf-8"))
    data["cameras"][1]["pupil"]["with_frame"] = data["cameras"][1]["pupil"]["with_frame"][:-1]
    path = tmp_path / "spoilt.json"
    path.write_text(json.dumps(data), encoding="utf-8")
    with pytest.raises(InputError, match=r"spoilt\.json.*damaged.*calibrate again"):
        load_saved_rig(path)


def test_cameras_of_points_in_mm_have_the_pupils(saved: Path, caplog: pytest.LogCaptureFixture) -> None:
    _, cameras, _ = import_pair(saved, near=True)
    pupils = load_saved_rig(saved).pupils
    for name, camera in zip(CAMERAS, cameras, strict=True):
        assert isinstance(camera, NearCamera)
        np.testing.assert_array_equal(camera.pupil, pupils[name].terms)
    assert "pupil" not in caplog.text


def test_a_central_approximation_is_reported(saved: Path, caplog: pytest.LogCaptureFixture) -> None:
    import_pair(saved)
    assert all(f"entrance pupil of camera '{name}' moves, which is left out here" in caplog.text for name in CAMERAS)


def test_a_certificate_is_of_cameras_with_their_pupils(rig: RigCalibration, saved: Path) -> None:
    """Lengths that both cameras see near by are within the bound, and as a central camera few are."""
    task = Task(quantity=Quantity.LENGTH, size_mm=30.0, distance_mm=150.0)
    found = certify_file(saved, task).certificate
    instrument = found.instrument
    assert any("its moving entrance pupil is included" in finding.message for finding in found.findings)
    assert (np.linalg.eigvalsh(instrument.covariance) > -1e-12).all()
    true, (left, right) = CAMERAS["left"][0], instrument.cameras
    assert isinstance(left, NearCamera) and isinstance(right, NearCamera)
    known, own = rig.pupils["left"], slice(left.parameters.size - 2, left.parameters.size)
    np.testing.assert_allclose(instrument.covariance[own, own], known.covariance, rtol=1e-6)
    np.testing.assert_allclose(instrument.covariance[-6:, own], known.with_frame[-6:], rtol=1e-5, atol=1e-12)
    # Not at the rim, where an end may leave the view of a central lens.
    inner = found.in_view & (true.unproject(found.pixels.reshape(-1, 2))[0][:, 2] > 0.3).reshape(found.in_view.shape)
    rays = true.unproject(found.pixels[inner])[0]
    ends = measured_points(rays, task, is_rig=True)[0][:, :2].reshape(-1, 3)
    seen = [camera.project(pose.apply(ends))[0] for camera, pose in CAMERAS.values()]
    bound, pose = found.bound[inner], instrument.cam_from_rig[1]
    off = []
    for cameras in ((left, right), (left.lens, right.lens)):
        points = ends.copy()
        for _ in range(6):
            rows, residuals = [], []
            for camera, moved, pixels in zip(cameras, (Rigid3.identity(), pose), seen, strict=True):
                shown, _, d_pixels_d_point, _ = camera.project_with_jacobians(moved.apply(points))
                rows.append(d_pixels_d_point @ moved.rotation)
                residuals.append(pixels - shown)
            step = np.linalg.pinv(np.concatenate(rows, axis=1)) @ np.concatenate(residuals, axis=1)[..., None]
            points = points + step[..., 0]
        both = points.reshape(-1, 2, 3)
        off.append(np.abs(np.linalg.norm(both[:, 1] - both[:, 0], axis=1) - task.size_mm))
    assert np.mean(off[0] <= bound) > 0.9 > 0.5 > np.mean(off[1] <= bound)


def test_fresh_boards_are_checked_with_the_pupils(rig: RigCalibration, saved: Path) -> None:
    fresh = [(c, frame, view) for c, own in enumerate(frames(4, 1).values()) for frame, view in own]
    for monitored in (load_monitored(saved)[0], monitored_rig(rig.mounted)):
        seen = [FreshView(f, c, view) for c, f, view in fresh]
        assert check_views(monitored, seen).rms_px < 0.06
        for k, own in enumerate(monitored.layout.cameras):
            pupil = slice(own.stop - 2, own.stop)
            known = rig.pupils[monitored.names[k]].covariance
            np.testing.assert_allclose(monitored.covariance[pupil, pupil], known, rtol=0.05)
    lenses = [camera.with_parameters([*camera.parameters[:-2], 0.0, 0.0]) for camera in monitored.cameras]
    assert check_views(replace(monitored, cameras=tuple(lenses)), seen).rms_px > 0.1


def test_frames_are_planned_with_the_pupils(saved: Path) -> None:
    monitored, boards = load_monitored(saved)
    assert all(isinstance(camera, NearCamera) for camera in monitored.cameras)
    plan, (reported, powers) = next_frames(monitored, boards, 2), informative_views(monitored, boards, 2)
    assert len(plan.views) == len(reported.views) == 2
    assert plan.views[1].error < plan.views[0].error < plan.error
    assert {power.kind for power in powers} >= {"focus", "rotation"}
