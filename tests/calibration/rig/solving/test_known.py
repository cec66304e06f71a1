"""Known lenses, and known cameras of a rig, are held, and their covariance is propagated."""

from __future__ import annotations

import numpy as np
import pytest
from helpers.calibration_scenes import BOARD, REACH_DEG, lens, random_views
from helpers.rig_scenes import NOISE_PX, mounts, rig_views, sizes

from rigkit.calibration.posed import posed_calibration
from rigkit.calibration.rig.calibrate import calibrate_rig
from rigkit.calibration.rig.solving.known import KnownCameras
from rigkit.cameras.base import Camera
from rigkit.core.errors import DegenerateError, InputError
from rigkit.geometry.rigid3 import Rigid3
from rigkit.geometry.rotation import log_so3

NOISE_OF_EACH = 0.01
"""Each solution states the noise that its lenses' departures leave of its own residuals (4e-3 of the errors of a mount
was seen), and errors have terms of the second order (4e-4)."""
BOW_ERROR_MM = 0.05
"""Of a bow of 1 mm in 14 views with corners of 0.2 px: 0.01 was seen."""


def off_in_sigmas(pose: Rigid3, true: Rigid3, covariance: np.ndarray) -> float:
    """The mount's error as a chi of six numbers, over the root of six."""
    error = np.concatenate([log_so3(pose.rotation @ true.rotation.T), pose.translation_mm - true.translation_mm])
    return float(np.sqrt(error @ np.linalg.solve(covariance, error) / 6.0))


def test_lenses_that_are_known_stay_and_the_mounts_are_found(rng: np.random.Generator) -> None:
    views = rig_views(rng, 12)
    known = KnownCameras({name: (camera, None) for name, (camera, _) in mounts().items()})
    rig = calibrate_rig(views, sizes(), known=known)
    for k, camera in enumerate(rig.cameras):
        assert camera.camera.parameters == pytest.approx(lens(camera.name).parameters, rel=1e-9, abs=1e-12)
        if k:
            covariance = rig.covariance[rig.mount(k), rig.mount(k)]
            assert off_in_sigmas(camera.cam_from_rig, mounts()[camera.name][1], covariance) < 2.0
    assert rig.sigma_px == pytest.approx(NOISE_PX, rel=0.1)
    assert rig.heldout_rms_px == pytest.approx(np.sqrt(2.0) * NOISE_PX, rel=0.1)


def test_mounts_of_lenses_not_known_exactly_are_as_unsure(rng: np.random.Generator) -> None:
    """With the covariance of another calibration the mounts are less sure than with exact lenses, and by what its
    errors do: one standard deviation of each of the independent errors that make it up moves the mounts by so much."""
    views = rig_views(rng, 12)
    two = {name: views[name] for name in ("reg", "wide")}
    exact = {name: (lens(name), None) for name in two}
    free = calibrate_rig(
        {name: rig_views(np.random.default_rng(7), 12)[name] for name in two},
        sizes(),
        model={"reg": "brown", "wide": "kannala_brandt"},
    )
    count = sum(camera.parameters.size for camera, _ in exact.values())
    covariance = free.covariance[:count, :count]
    sure = calibrate_rig(two, sizes(), known=KnownCameras(exact))
    unsure = calibrate_rig(two, sizes(), known=KnownCameras(exact, covariance))
    with_error, without = (rig.widening**2 * rig.covariance[rig.mount(1), rig.mount(1)] for rig in (unsure, sure))
    added = with_error - without
    there = sure.cameras[1].cam_from_rig
    moved = []
    for error in np.linalg.cholesky(covariance).T:
        wrong, start = {}, 0
        for name, (camera, _) in exact.items():
            size = camera.parameters.size
            wrong[name] = (camera.with_parameters(camera.parameters + error[start : start + size]), None)
            start += size
        pose = calibrate_rig(two, sizes(), known=KnownCameras(wrong), folds=0).cameras[1].cam_from_rig
        moved.append(
            np.concatenate([log_so3(pose.rotation @ there.rotation.T), pose.translation_mm - there.translation_mm])
        )
    assert np.sqrt(np.sum(np.square(moved), axis=0)) == pytest.approx(np.sqrt(np.diag(added)), rel=NOISE_OF_EACH)


def test_a_camera_is_added_to_a_rig_that_stays(rng: np.random.Generator) -> None:
    cameras = mounts()
    before = {name: cameras[name] for name in ("reg", "wide")}
    rig = calibrate_rig(
        rig_views(rng, 12),
        sizes(),
        model={"reg": "brown", "wide": "kannala_brandt", "fish": "kannala_brandt"},
        known=KnownCameras(before),
    )
    for camera in rig.cameras[:2]:
        true_lens, true_mount = before[camera.name]
        assert camera.camera.parameters == pytest.approx(true_lens.parameters, rel=1e-9, abs=1e-12)
        assert camera.cam_from_rig.matrix() == pytest.approx(true_mount.matrix(), abs=1e-6)
    new = rig.cameras[2]
    assert new.camera.parameters != pytest.approx(lens("fish").parameters, rel=1e-12)
    assert off_in_sigmas(new.cam_from_rig, cameras["fish"][1], rig.covariance[rig.mount(2), rig.mount(2)]) < 2.0


def test_a_lens_of_another_size_or_place_is_refused(rng: np.random.Generator) -> None:
    views, cameras = rig_views(rng, 6), mounts()
    two = {name: views[name] for name in ("wide", "reg")}
    with pytest.raises(InputError, match="known lens is of"):
        calibrate_rig(two, sizes() | {"reg": (640, 480)}, known=KnownCameras({"reg": (lens("reg"), None)}))
    with pytest.raises(InputError, match="has to be the first"):
        calibrate_rig(two, sizes(), known=KnownCameras({"reg": cameras["reg"]}))
    with pytest.raises(InputError, match="has no views"):
        calibrate_rig(two, sizes(), known=KnownCameras({"fish": (lens("fish"), None)}))


def test_views_under_a_wrong_lens_say_so(rng: np.random.Generator) -> None:
    views = [view for _, view in rig_views(rng, 6)["wide"]]
    right = posed_calibration(views, lens("wide"))
    assert right.rms_px == pytest.approx(np.sqrt(2.0) * NOISE_PX, rel=0.1)
    try:
        wrong = posed_calibration(views, _longer(lens("wide")))
    except DegenerateError:
        return
    assert wrong.rms_px > 5.0 * right.rms_px


def _longer(camera: Camera) -> Camera:
    parameters = camera.parameters.copy()
    parameters[4:] += 0.2
    return camera.with_parameters(parameters)


def bowed(height_mm: float) -> np.ndarray:
    """How far the corners of a board that is bowed along x are from its plane, (54, 3)."""
    x = BOARD.points()[:, 0]
    across = (x - x.mean()) / (0.5 * np.ptp(x))
    return np.outer(height_mm * (1.0 - across**2), [0.0, 0.0, 1.0])


@pytest.mark.parametrize(("bow_mm", "shape"), [(0.0, "flat"), (1.0, "warp")])
def test_a_board_that_is_bent_is_bent_before_a_known_lens(bow_mm: float, shape: str, rng: np.random.Generator) -> None:
    points = BOARD.points() + bowed(bow_mm)
    views, _, _ = random_views(lens("reg"), 14, rng, reach_deg=REACH_DEG["reg"], noise_px=NOISE_PX, points_mm=points)
    found = posed_calibration(views, lens("reg"), board="auto")
    (board,) = found.boards
    assert board.kind == shape
    assert found.camera.parameters.tolist() == lens("reg").parameters.tolist()
    assert found.rms_px == pytest.approx(np.sqrt(2.0) * NOISE_PX, rel=0.1)
    height = board.points_mm[:, 2] - points[:, 2]
    assert np.abs(height - height.mean()).max() < BOW_ERROR_MM


def test_mounts_of_known_lenses_before_a_bent_board(rng: np.random.Generator) -> None:
    """Taken as flat, a board bowed by 1 mm leaves the mount less sure by far."""
    names = ("reg", "wide")
    known = KnownCameras({name: (camera, None) for name, (camera, _) in mounts().items() if name in names})
    views = {name: own for name, own in rig_views(rng, 12, bumps_mm=bowed(1.0)).items() if name in names}
    unsure = {}
    for board in ("flat", "auto"):
        rig = calibrate_rig(views, sizes(), known=known, board=board)
        mount = rig.cameras[1].cam_from_rig
        own = rig.covariance[rig.mount(1), rig.mount(1)]
        assert off_in_sigmas(mount, mounts()["wide"][1], own) < 2.0
        unsure[board] = np.sqrt(np.trace(own[3:, 3:]))
    assert unsure["auto"] < 0.5 * unsure["flat"]
    assert rig.sigma_px == pytest.approx(NOISE_PX, rel=0.1)
