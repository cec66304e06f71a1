"""Other methods find the geometry, agree with a right reconstruction, and contradict a wrong one."""

from __future__ import annotations

import json
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from helpers.board_scenes import fisheye_camera, regular_camera
from helpers.reconstructions import BOARDS, CAM2_FROM_CAM1, make_reconstruction, trihedral_poses

from rigkit.calibration.board_shape import BoardShape
from rigkit.cameras.base import Camera
from rigkit.cameras.brown import Brown
from rigkit.cameras.eucm import EUCM
from rigkit.cameras.uncertain import UncertainCamera
from rigkit.core.detections import grid_turned
from rigkit.core.errors import DegenerateError
from rigkit.geometry.relative_pose import relative_pose, relative_pose_covariance
from rigkit.geometry.rigid3 import Rigid3
from rigkit.geometry.rotation import exp_so3, log_so3, rotation_angle
from rigkit.interop.colmap import colmap_pair, solve_pair
from rigkit.reconstruction.calibration_shifts import calibration_shifts
from rigkit.reconstruction.reconstruct import Reconstruction
from rigkit.validation.crosscheck import ADJUSTED, PNP, crosscheck, sigma_of_difference
from rigkit.validation.measure import measure
from rigkit.validation.pnp import planar_pnp

EXACT_RAD = 1e-6
"""Exact corners: what COLMAP's stopping rule and our 1e-9 leave, with a margin."""
EXACT_MM = 1e-3
SIGMA_RATIO = (0.8, 1.2)
"""Observed over predicted spread of 100 draws: its own standard deviation is 1 / sqrt(200) = 7 %."""
PNP_DRAWS = 50
PNP_SIGMA_RATIO = (0.7, 1.3)
FIRST_ORDER_REL = 0.05
"""Of how far a calibration that is off by one sigma moves an angle: what higher orders may add."""
"""50 draws: 10 %."""
POSE_COVARIANCE = np.diag([1e-5] * 3 + [0.02] * 3) ** 2

CAMERAS = {
    "pinhole": regular_camera(),
    "brown": Brown((1624, 1240), np.array([1356.0, 1350.0, 820.5, 605.5, -0.1, 0.03, 1e-3, -5e-4, 0.01])),
    "kannala_brandt": fisheye_camera(),
    "eucm": EUCM((1624, 1240), np.array([600.0, 600.0, 811.5, 619.5, 0.6, 1.1])),
}


def made(camera: Camera, **options: Any) -> Reconstruction:
    return make_reconstruction(camera=camera, pose_covariance=POSE_COVARIANCE, baseline_sigma_mm=0.02, **options)


def noisy(exact: Reconstruction, rng: np.random.Generator, sigma_px: float = 0.05) -> Reconstruction:
    noise = rng.normal(size=(2, len(exact.pixels1), 2)) * sigma_px
    return replace(exact, pixels1=exact.pixels1 + noise[0], pixels2=exact.pixels2 + noise[1])


@pytest.mark.parametrize("name", CAMERAS)
def test_every_way_finds_the_exact_geometry(name: str) -> None:
    report = crosscheck(made(CAMERAS[name]))
    assert report.passed
    assert not report.skipped
    assert len(report.checks) == 15
    for method in report.methods:
        assert method.used == 144
        assert np.deg2rad(method.rotation_difference_deg) < EXACT_RAD
        assert np.deg2rad(method.direction_difference_deg) < EXACT_RAD
        assert method.baseline_mm == pytest.approx(np.linalg.norm(CAM2_FROM_CAM1.translation_mm), abs=EXACT_MM)
        for angle, _ in method.angles_deg.values():
            assert angle == pytest.approx(90.0, abs=1e-4)
    assert json.loads(report.to_json())["passed"] is True


@pytest.mark.parametrize("name", CAMERAS)
def test_the_half_pixel_is_handled(name: str) -> None:
    # COLMAP must see the same rays in its own pixels: an origin off by half a pixel is 4e-4 rad here.
    exact = made(CAMERAS[name])
    pair = colmap_pair(exact.camera1, exact.camera2, exact.pixels1, exact.pixels2)
    seen = np.asarray(pair.cameras[0].cam_from_img(pair.pixels1))
    rays, _ = exact.camera1.unproject(exact.pixels1)
    assert np.abs(seen - rays[:, :2] / rays[:, 2:]).max() < 1e-9
    if name != "eucm":
        assert (pair.pixels1 == exact.pixels1 + 0.5).all()


def test_rays_beyond_90_degrees_are_left_out_and_counted() -> None:
    exact = made(fisheye_camera())
    # The same scene seen by a camera turned aside: some corners lie behind its image plane.
    aside = Rigid3(exp_so3(np.array([0.0, 1.42, 0.0])), np.zeros(3))
    points = aside.apply(exact.cloud.points_mm)
    camera = fisheye_camera()
    pixels1, valid = camera.project(points)
    cam2_from_aside = CAM2_FROM_CAM1 @ aside.inverse()
    behind = points[:, 2] < 0.0
    assert valid.all()
    assert 5 < behind.sum() < 40
    turned = replace(
        exact,
        pixels1=pixels1,
        cam2_from_cam1=cam2_from_aside,
        cloud=replace(exact.cloud, points_mm=points, normals=exact.cloud.normals @ aside.rotation.T),
    )
    report = crosscheck(turned)
    assert report.passed
    assert behind.sum() <= report.method(ADJUSTED).excluded < 144
    assert report.method(ADJUSTED).used + report.method(ADJUSTED).excluded == 144
    # The boards' own poses need no image plane.
    assert report.method(PNP).used == 144


def test_colmap_covariance_is_the_observed_one(rng: np.random.Generator) -> None:
    exact = made(regular_camera())
    unit_direction = CAM2_FROM_CAM1.translation_mm / np.linalg.norm(CAM2_FROM_CAM1.translation_mm)
    turns, moves, variances = [], [], []
    for _ in range(100):
        drawn = noisy(exact, rng)
        found = solve_pair(colmap_pair(drawn.camera1, drawn.camera2, drawn.pixels1, drawn.pixels2))
        turns.append(log_so3(found.adjusted.rotation @ CAM2_FROM_CAM1.rotation.T))
        moves.append(found.adjusted.translation_mm - unit_direction)
        variances.append(np.diag(found.adjusted_covariance) * 0.05**2)
    ratio = np.std(np.hstack([turns, moves]), axis=0) / np.sqrt(np.mean(variances, axis=0))
    assert (ratio > SIGMA_RATIO[0]).all(), ratio
    assert (ratio < SIGMA_RATIO[1]).all(), ratio


def test_pnp_covariance_is_the_observed_one(rng: np.random.Generator) -> None:
    exact = made(regular_camera())
    offsets, variances, angles = [], [], []
    for _ in range(PNP_DRAWS):
        found = planar_pnp(noisy(exact, rng))
        turn = log_so3(found.cam2_from_cam1.rotation @ CAM2_FROM_CAM1.rotation.T)
        offsets.append(np.hstack([turn, found.cam2_from_cam1.translation_mm - CAM2_FROM_CAM1.translation_mm]))
        variances.append(np.diag(found.covariance))
        angles.append([value for pair in found.angles_deg.values() for value in pair])
    spread = np.std(angles, axis=0)[::2] / np.mean(angles, axis=0)[1::2]
    ratio = np.concatenate([np.std(offsets, axis=0) / np.sqrt(np.mean(variances, axis=0)), spread])
    assert (ratio > PNP_SIGMA_RATIO[0]).all(), ratio
    assert (ratio < PNP_SIGMA_RATIO[1]).all(), ratio


def test_one_seed_gives_one_answer(rng: np.random.Generator) -> None:
    drawn = noisy(made(regular_camera()), rng)
    assert crosscheck(drawn).to_json() == crosscheck(drawn).to_json()


def test_a_wrong_pose_is_contradicted_by_both_methods(rng: np.random.Generator) -> None:
    exact = made(regular_camera())
    wrong = Rigid3(exp_so3(np.array([0.0, 0.002, 0.0])) @ CAM2_FROM_CAM1.rotation, CAM2_FROM_CAM1.translation_mm)
    report = crosscheck(noisy(replace(exact, cam2_from_cam1=wrong), rng))
    failed = {(c.how, c.kind) for c in report.checks if not c.passed}
    assert {(ADJUSTED, "rotation"), (PNP, "rotation")} <= failed
    assert "relative pose" in report.diagnosis[0]


def test_a_bent_board_is_contradicted_by_pnp_only(rng: np.random.Generator) -> None:
    # The epipolar methods measure the faces as they stand; the boards' own poses trust the print.
    exact = made(regular_camera())
    board = replace(BOARDS[1], square_y_mm=BOARDS[1].square_y_mm * 1.01)
    report = crosscheck(noisy(replace(exact, boards=(BOARDS[0], board, BOARDS[2])), rng))
    assert any(c.how == PNP and not c.passed for c in report.checks)
    assert all(c.passed for c in report.checks if c.how == ADJUSTED)
    assert "calibration or board" in report.diagnosis[0]


@pytest.mark.parametrize("turns", [0, 2])
def test_a_bent_board_agrees_where_its_shape_was_measured(rng: np.random.Generator, turns: int) -> None:
    """Squares that are longer one way, and at one end; the calibration may have counted them from the other end."""
    exact = made(regular_camera(), keep=(1,))
    true = exact.boards[0]
    middle = true.points().mean(axis=0)
    x, y, _ = (true.points() - middle).T / 200.0
    on_board = middle + 200.0 * np.stack([1.006 * x + 0.01 * x**2, 0.994 * y, 0.0 * x], axis=1)
    cam1_from_board = trihedral_poses()[1]
    in_cam1 = cam1_from_board.apply(on_board[true.index(exact.cloud.grid)])
    pixels1, pixels2 = (exact.camera1.project(p)[0] for p in (in_cam1, CAM2_FROM_CAM1.apply(in_cam1)))
    seen = noisy(replace(exact, pixels1=pixels1, pixels2=pixels2), rng, 0.02)
    order = true.index(grid_turned(true.grid(), true.size, turns))
    counted = np.empty_like(on_board)
    counted[order] = on_board if turns == 0 else (2.0 * middle - on_board) * [1.0, 1.0, -1.0]
    found = planar_pnp(seen, {true.board_id: BoardShape.of(true, "released", counted)})
    assert found.rms_rad < 0.1 * planar_pnp(seen).rms_rad
    assert np.deg2rad(0.1) > rotation_angle(found.cam2_from_cam1.rotation @ CAM2_FROM_CAM1.rotation.T)


def test_another_chain_is_compared(rng: np.random.Generator) -> None:
    exact = made(regular_camera())
    report = crosscheck(exact, other_chain=exact)
    assert report.passed
    assert len(report.checks) == 21
    moved = replace(exact, cam2_from_cam1=Rigid3(CAM2_FROM_CAM1.rotation, CAM2_FROM_CAM1.translation_mm * 1.01))
    report = crosscheck(exact, other_chain=moved)
    assert not report.passed
    assert "rectification" in report.diagnosis[-1]


def test_the_sigma_of_a_difference_is_that_of_estimates_from_the_same_data(rng: np.random.Generator) -> None:
    """The mean, which is efficient, and the median of the same numbers differ by less than independent ones would."""
    count, draws = 101, 4000
    numbers = rng.normal(size=(draws, count))
    mean, median = numbers.mean(axis=1), np.median(numbers, axis=1)
    predicted = sigma_of_difference(float(mean.std()), float(median.std()), 10**9)
    assert np.std(median - mean) == pytest.approx(predicted, rel=0.08)
    assert predicted < 0.6 * np.hypot(mean.std(), median.std())
    # Variances from few residuals are not known well enough to call equal sigmas no difference at all.
    assert sigma_of_difference(1.0, 1.0, 50) == pytest.approx(0.2**0.5)


def test_no_way_at_all_is_an_error() -> None:
    exact = make_reconstruction()
    few = np.arange(5)
    cut = replace(
        exact,
        pixels1=exact.pixels1[few],
        pixels2=exact.pixels2[few],
        cloud=replace(
            exact.cloud,
            **{
                name: getattr(exact.cloud, name)[few]
                for name in ("points_mm", "normals", "colours", "board_index", "grid", "sigma_mm", "normal_sigma_rad")
            },
        ),
    )
    with pytest.raises(DegenerateError, match="8 corners"):
        planar_pnp(cut)
    with pytest.raises(DegenerateError, match="no relative pose"):
        solve_pair(colmap_pair(cut.camera1, cut.camera2, cut.pixels1, cut.pixels2))


def test_relative_covariance_is_the_sampled_one(rng: np.random.Generator) -> None:
    one, two = trihedral_poses()[:2]
    half = rng.normal(size=(12, 12)) * np.array(([1e-4] * 3 + [0.1] * 3) * 2)[:, None]
    pose = relative_pose(one, two)
    samples = []
    for move in rng.normal(size=(4000, 12)) @ half.T:
        shaken = [
            Rigid3(exp_so3(m[:3]) @ p.rotation, p.translation_mm + m[3:]) for p, m in ((one, move[:6]), (two, move[6:]))
        ]
        found = relative_pose(*shaken)
        turn = log_so3(found.rotation @ pose.rotation.T)
        samples.append(np.hstack([turn, found.translation_mm - pose.translation_mm]))
    predicted = relative_pose_covariance(one, two, half @ half.T)
    # 4000 draws: 1.1 % per standard deviation.
    assert np.std(samples, axis=0) == pytest.approx(np.sqrt(np.diag(predicted)), rel=0.05)


def test_calibrations_move_only_the_boards_own_poses_apart() -> None:
    """The share in the sigmas of the angles is what calibrations show of which one parameter is off by its sigma."""
    exact = made(CAMERAS["kannala_brandt"])
    axes = np.diag(np.where(np.abs(exact.camera1.parameters) > 1.0, 0.3, 3e-4))
    known = UncertainCamera(exact.camera1, axes**2)
    plain, honest = (crosscheck(exact, shifts=s) for s in (None, calibration_shifts(exact, known)))
    share: dict[str, float] = {}
    for before, after in zip(plain.checks, honest.checks, strict=True):
        added = after.combined_sigma**2 - before.combined_sigma**2
        assert added > 0.0 if before.how == PNP else added == 0.0
        if before.how == PNP and before.kind == "angle":
            share[before.name] = np.sqrt(added)
    apart = []
    for axis in axes:
        (moved,) = calibration_shifts(exact, replace(known, covariance=np.outer(axis, axis))).moved
        ours = measure(moved)
        apart.append([ours.angle_deg(*two)[0] - value for two, (value, _) in planar_pnp(moved).angles_deg.items()])
    # To first order variances of independent causes add up.
    np.testing.assert_allclose(np.sqrt(np.square(apart).sum(axis=0)), list(share.values()), rtol=FIRST_ORDER_REL)


def test_one_board_is_no_case_for_pycolmap() -> None:
    report = crosscheck(made(CAMERAS["brown"], keep=(2,)))
    assert report.passed
    assert [method.name for method in report.methods] == [PNP]
    assert "on one plane" in report.skipped[0]
