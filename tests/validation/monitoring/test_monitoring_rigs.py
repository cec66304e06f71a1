"""`rigkit check` of rigs: changed mounts, from boards and from scenes without boards."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from helpers.calibration_scenes import lens, noisy_view
from helpers.monitoring_scenes import NOISE_PX, known_rig, poses_held, scene_pixels

from rigkit.affine.correspondences import Correspondences
from rigkit.affine.refine_patches import HALF_WIDTH_OF_FEATURE, WINDOW_OF_PATCH
from rigkit.cameras.base import Camera
from rigkit.cameras.brown import Brown
from rigkit.cameras.compare import grid_pixels
from rigkit.core.errors import DegenerateError
from rigkit.core.measurement_task import Quantity, Task
from rigkit.core.reach import Reach
from rigkit.geometry.rigid3 import Rigid3
from rigkit.geometry.rotation import exp_so3, unit
from rigkit.io.calibrations.history_file import HistoryEntry
from rigkit.report.pages.check_page import check_facts
from rigkit.validation.certificate.propagation import measured_points
from rigkit.validation.monitoring.epipolar import (
    PairMatches,
    check_matches,
    evidence_of_matches,
    without_alignment_bias,
)
from rigkit.validation.monitoring.evidence import FreshEvidence, FreshView, Monitored
from rigkit.validation.monitoring.verdict import ALARM_PX, CalibrationCheck, check_views, evaluate_evidence
from rigkit.workflows.calibration.next_pictures import TASK_CELLS, length_goal, length_goals

MATCH_NOISE_PX, FINE_MATCH_NOISE_PX = 0.3, 0.07


MOUNT = Rigid3(exp_so3(np.array([0.01, -0.08, 0.02])), [-120.0, 2.0, 3.0])
TURN_DEG = [0.02, -0.015, 0.03]
LENS_SIGMAS = [0.1, 0.1, 0.1, 0.1, 2e-5, 2e-5, 2e-5, 2e-5]


def _rig() -> Monitored:
    return known_rig(MOUNT, LENS_SIGMAS, 2e-5, 20.0)


BENT = Brown((1280, 960), np.array([640.0, 640.0, 639.5, 479.5, -0.22, 0.06, 2e-4, -2e-4, -0.006]))
DISTORTED = replace(
    _rig(),
    cameras=(BENT, BENT),
    cam_from_rig=(Rigid3.identity(), MOUNT),
    covariance=np.diag([*[0.005] * 4, *[5e-6] * 5] * 2 + [*[5e-6] * 3, *[0.01] * 3]) ** 2,
)
"""Of 90 degrees."""
NEAR = Reach(nearest_mm=300.0)


def _rig_check(pose: Rigid3, second: Camera, rng: np.random.Generator) -> CalibrationCheck:
    rig, views = _rig(), []
    for k, held in enumerate(poses_held("wide", 3, NEAR)):
        views.append(FreshView(f"{k}", 0, noisy_view(rig.cameras[0], held, f"{k}", rng, NOISE_PX)))
        views.append(FreshView(f"{k}", 1, noisy_view(second, pose @ held, f"{k}", rng, NOISE_PX)))
    return check_views(rig, views)


def test_an_unchanged_rig_holds() -> None:
    checks = [_rig_check(MOUNT, lens("wide"), np.random.default_rng(seed)) for seed in range(5)]
    assert all(check.holds for check in checks)
    powers = {(p.kind, p.camera): p for p in checks[0].powers}
    assert set(powers) == {(k, c) for k in ("focus", "principal point", "distortion") for c in ("left", "right")} | {
        ("rotation", "right")
    }
    # The turn that is found below is one that is said to be found.
    assert powers["rotation", "right"].unit == "deg" and powers["rotation", "right"].found_from < np.linalg.norm(
        TURN_DEG
    )


def test_a_camera_that_turned_is_found_to_a_hundredth_of_a_degree(rng: np.random.Generator) -> None:
    turn = np.radians(TURN_DEG)
    moved = Rigid3(exp_so3(turn) @ MOUNT.rotation, exp_so3(turn) @ MOUNT.translation_mm)
    check = _rig_check(moved, lens("wide"), rng)
    assert not check.holds and check.change is not None
    assert (check.change.hypothesis.kind, check.change.hypothesis.camera) == ("rotation", "right")
    assert check.change.amounts == pytest.approx(np.degrees(turn), abs=4.0 * float(check.change.sigmas.max()))
    assert check.change.sigmas.max() < 0.01
    # A rig's file may come from anywhere.
    assert "--before" in check_facts(check).sentences[-1]


def test_a_longer_baseline_is_a_change_of_scale_or_shift(rng: np.random.Generator) -> None:
    moved = Rigid3(MOUNT.rotation, 1.01 * MOUNT.translation_mm)
    check = _rig_check(moved, lens("wide"), rng)
    assert not check.holds and check.change is not None
    assert check.change.hypothesis.kind == "scale"
    assert check.change.amounts == pytest.approx([1.0], abs=0.1)


def _matches(pose: Rigid3, rng: np.random.Generator, noise_px: float = MATCH_NOISE_PX) -> PairMatches:
    noisy = scene_pixels(pose, 600, noise_px, rng)
    # One match in ten is wrong.
    wrong = rng.random(len(noisy[0])) < 0.1
    noisy[1][wrong] += rng.uniform(-60.0, 60.0, (int(wrong.sum()), 2))
    return PairMatches(0, 1, np.clip(noisy[0], 0.0, None), np.clip(noisy[1], 0.0, None))


def test_a_changed_mount_is_found_from_a_scene_without_boards() -> None:
    quiet, named, draws = 0, 0, 3
    turn = np.radians([0.05, 0.0, 0.0])
    moved = Rigid3(exp_so3(turn) @ MOUNT.rotation, exp_so3(turn) @ MOUNT.translation_mm)
    for seed in range(draws):
        rng = np.random.default_rng(seed)
        quiet += check_matches(_rig(), [_matches(MOUNT, rng)]).holds
        alarmed = check_matches(_rig(), [_matches(moved, rng)])
        assert not alarmed.holds
        named += alarmed.change is not None and alarmed.change.hypothesis.kind == "rotation"
    assert quiet == named == draws


def _aligned(rng: np.random.Generator) -> tuple[PairMatches, PairMatches]:
    """Patches of planes, aligned by affine warps without noise: as they are found, and as the rig straightens them."""
    camera, offset = DISTORTED.cameras[0], np.arange(-HALF_WIDTH_OF_FEATURE, HALF_WIDTH_OF_FEATURE + 1.0)
    pixels1 = rng.uniform([20.0, 20.0], [1260.0, 940.0], (400, 2))
    u = np.stack(np.meshgrid(offset, offset), axis=-1).reshape(-1, 2)
    weight = np.exp(-0.25 * (u**2).sum(axis=1) / (WINDOW_OF_PATCH * HALF_WIDTH_OF_FEATURE) ** 2)
    rays, seen1 = camera.unproject(pixels1[:, None] + u)
    middle, _ = camera.unproject(pixels1)
    normals = unit(-middle + 0.4 * rng.standard_normal(middle.shape))
    distance = rng.uniform(700.0, 2000.0, len(middle)) * np.sum(normals * middle, axis=1)
    points = rays * (distance[:, None] / np.einsum("nki,ni->nk", rays, normals))[..., None]
    pixels2, seen2 = camera.project(MOUNT.apply(points))
    kept = (seen1 & seen2 & camera.on_image(pixels2)).all(axis=1)
    # The affine warp that is nearest within the window.
    design = weight[:, None] * np.column_stack([np.ones(len(u)), u])
    warp = np.linalg.pinv(design) @ (weight[:, None] * pixels2[kept])
    found = Correspondences(pixels1[kept], warp[:, 0], np.swapaxes(warp[:, 1:], 1, 2))
    return PairMatches(0, 1, found.pixels1, found.pixels2), without_alignment_bias(DISTORTED, (0, 1), found)


def test_what_an_affine_warp_leaves_of_the_map_between_lenses_is_taken_back(rng: np.random.Generator) -> None:
    found, straight = _aligned(rng)
    before, after = check_matches(DISTORTED, [found]), check_matches(DISTORTED, [straight])
    # Half of what a match is taken to err by, but alike wherever it is.
    assert before.rms_px > 0.008
    assert after.holds and after.rms_px < 0.3 * before.rms_px


def test_matches_without_information_are_refused() -> None:
    with pytest.raises(DegenerateError, match="texture"):
        check_matches(_rig(), [])
    # All in one corner of the image; and none that a lens sees.
    few = _matches(MOUNT, np.random.default_rng(0))
    near = (few.pixels1 < [800.0, 600.0]).all(axis=1) & (few.pixels1 > [406.0, 310.0]).all(axis=1)
    assert check_matches(_rig(), [PairMatches(0, 1, few.pixels1[near], few.pixels2[near])]).corners == near.sum() > 20
    # A mount that is said to be exact.
    exact = replace(_rig(), covariance=np.diag([*np.array(LENS_SIGMAS) ** 2, *np.array(LENS_SIGMAS) ** 2, *[0.0] * 6]))
    assert check_matches(exact, [few]).holds
    with pytest.raises(DegenerateError, match="none of the matches"):
        check_matches(_rig(), [PairMatches(0, 1, np.full((50, 2), np.nan), np.full((50, 2), np.nan))])


def test_pictures_too_far_off_to_linearise_are_not_of_these_cameras(tmp_path: Path) -> None:
    rig = _rig()
    far = FreshEvidence(
        information=np.full((1, rig.layout.count, rig.layout.count), np.inf),
        score=np.full((1, rig.layout.count), np.inf),
        variance_px2=0.01,
        rms_px=50.0,
        expected_px=0.1,
        corners=100,
        left_out=0,
        overdispersion=1.0,
        freedom=10.0,
    )
    check = evaluate_evidence(rig, lambda _: far)
    assert check.unexplained and not check.holds and check.change is None
    assert "no change of the camera or rig explains it" in check_facts(check).headline
    assert HistoryEntry.of_check(check, tmp_path).verdict == "no change of the camera or rig explains it"
    # Where residuals are small, the calibration's parameters are wrong.
    with pytest.raises(DegenerateError, match="parameters in the calibration file"):
        evaluate_evidence(rig, lambda _: replace(far, rms_px=0.1))


@pytest.mark.parametrize("turn", [0.0, 0.3], ids=["first camera's frame", "own frame"])
def test_what_a_change_of_a_rig_costs_in_a_length(turn: float) -> None:
    """The old rig measures points that the changed one sees."""
    from_frame = Rigid3(exp_so3(np.array([0.0, turn, 0.0])), 500.0 * np.array([turn, 0.0, -turn]))
    placed = tuple(pose @ from_frame for pose in _rig().cam_from_rig)
    monitored = replace(_rig(), cam_from_rig=placed)
    task = Task(quantity=Quantity.LENGTH, size_mm=100.0, distance_mm=700.0)
    step = np.zeros(monitored.layout.count)
    step[monitored.layout.cameras[0]][:2] = 0.3
    step[monitored.layout.mount(1)] = 2e-4, 4e-4, -3e-4, 0.02, 0.0, 0.01
    now, (goal,) = monitored.changed(step), length_goals(monitored.cameras, monitored.cam_from_rig, task)
    rays, valid = monitored.cameras[0].unproject(grid_pixels(monitored.cameras[0].size_px, TASK_CELLS).reshape(-1, 2))
    points = placed[0].inverse().apply(measured_points(rays[valid], task, is_rig=True)[0])
    seen, shown = np.ones(len(points), dtype=bool), []
    for camera, pose in zip(now.cameras, now.cam_from_rig, strict=True):
        pixels, sees = camera.project(pose.apply(points))
        seen &= (sees & camera.on_image(pixels)).all(axis=1)
        shown.append(pixels)
    found = points.copy()
    for _ in range(4):
        rows, left = [], []
        for camera, pose, pixels in zip(monitored.cameras, monitored.cam_from_rig, shown, strict=True):
            projected, _, d_pixels_d_point, _ = camera.project_with_jacobians(pose.apply(found))
            rows.append(d_pixels_d_point @ pose.rotation)
            left.append(pixels - projected)
        J, r = np.concatenate(rows, axis=-2)[seen], np.concatenate(left, axis=-1)[seen]
        JT = np.swapaxes(J, -1, -2)
        found[seen] += np.linalg.solve(JT @ J, JT @ r[..., None])[..., 0]
    lengths = np.linalg.norm(found[seen][:, 1::2] - found[seen][:, ::2], axis=-1)
    wrong = float(np.sqrt(((lengths - task.size_mm) ** 2).mean()))
    assert goal.unit == "mm" and np.sqrt(step @ goal.weight @ step) == pytest.approx(wrong, rel=0.02)
    far = Task(quantity=Quantity.LENGTH, size_mm=90000.0, distance_mm=700.0)
    with pytest.raises(DegenerateError, match="of no two cameras"):
        length_goals(monitored.cameras, monitored.cam_from_rig, far)


def test_a_length_that_fits_only_through_the_centre_of_the_image_is_in_view() -> None:
    """The grid of lengths has no row through the centre, that of certificates has one."""
    camera = Brown((640, 480), np.array([500.0, 500.0, 319.5, 239.5, 0.0, 0.0, 0.0, 0.0, 0.0]))
    # 475 of the 480 rows.
    task = Task(quantity=Quantity.LENGTH, size_mm=570.0, distance_mm=600.0)
    assert length_goal((camera,), (Rigid3.identity(),), task).unit == "mm"


def test_calibration_uncertainty_raises_no_alarm() -> None:
    """A mount known to 0.06 degrees only: matches are off by many times their scatter, as the calibration says."""
    sigmas = np.array([*LENS_SIGMAS, *LENS_SIGMAS, *[1e-3] * 3, *[0.01] * 3])
    unsure = replace(_rig(), covariance=np.diag(sigmas**2))
    for seed in range(9):
        rng = np.random.default_rng(seed)
        turn = 1e-3 * rng.standard_normal(3)
        moved = Rigid3(exp_so3(turn) @ MOUNT.rotation, exp_so3(turn) @ MOUNT.translation_mm)
        check = check_matches(unsure, [_matches(moved, rng)])
        assert check.holds and not check.unexplained
        assert check.rms_px < 3.0 * check.expected_px


@pytest.mark.parametrize("axis", range(3))
def test_a_change_does_not_hide_behind_the_scatter_it_makes(axis: int, rng: np.random.Generator) -> None:
    # Good matches, and a turn that moves them by many times their noise.
    turn = np.radians(0.3) * np.eye(3)[axis]
    moved = Rigid3(exp_so3(turn) @ MOUNT.rotation, exp_so3(turn) @ MOUNT.translation_mm)
    check = check_matches(_rig(), [_matches(moved, rng, FINE_MATCH_NOISE_PX)])
    assert check.expected_px < 2.0 * FINE_MATCH_NOISE_PX < 0.5 * check.rms_px
    assert check.chance < 1e-9 and check.change is not None and check.change.hypothesis.kind == "rotation"
    assert check.change.amounts == pytest.approx(np.degrees(turn), abs=4.0 * float(check.change.sigmas.max()))


@pytest.mark.parametrize("axis", range(3))
def test_isolated_outliers_do_not_change_the_hypothesis(axis: int) -> None:
    # A lens can bend to a few matches where there are no others: off by little, as those of tiles are by a period.
    turn = np.radians(0.05) * np.eye(3)[axis]
    moved = Rigid3(exp_so3(turn) @ MOUNT.rotation, exp_so3(turn) @ MOUNT.translation_mm)
    for seed in range(2):
        rng = np.random.default_rng(seed)
        whole = _matches(moved, rng, FINE_MATCH_NOISE_PX / 4.0)
        alone = whole.pixels1[:, 0] < 400.0
        few = np.flatnonzero(alone)[:12]
        pixels2 = whole.pixels2 + 0.0
        pixels2[few, 1] += 0.3
        kept = np.concatenate([few, np.flatnonzero(~alone)])
        check = check_matches(_rig(), [PairMatches(0, 1, whole.pixels1[kept], pixels2[kept])])
        assert not check.holds and check.change is not None and check.change.hypothesis.kind == "rotation"


def test_the_size_of_a_change_is_not_that_of_its_uncertainty() -> None:
    sizes = []
    for seed in range(8):
        matches = _matches(MOUNT, np.random.default_rng(seed))
        check = check_matches(_rig(), [PairMatches(0, 1, matches.pixels1[:60], matches.pixels2[:60])])
        assert check.change is not None
        sizes.append(check.change.size_px)
    # Nothing happened, and sixty matches do not say so well: of the estimates alone the median is 0.09 px.
    assert np.median(sizes) < ALARM_PX / 2.0


def test_few_matches_raise_no_alarm() -> None:
    """A fit of the lenses and the mount could follow so few, and what it left would pass for their scatter."""
    draws, lens_px = 12, 20.0
    unsure = replace(
        _rig(), covariance=np.diag([*lens_px * np.array(LENS_SIGMAS)] * 2 + [*[1e-3] * 3, *[1.0] * 3]) ** 2
    )
    for seed in range(draws):
        whole = _matches(MOUNT, np.random.default_rng(seed))
        check = check_matches(unsure, [PairMatches(0, 1, whole.pixels1[:25], whole.pixels2[:25])])
        assert check.holds and check.chance > 1e-3


def test_correlated_errors_of_neighbouring_matches_raise_no_alarm() -> None:
    chances = []
    for seed in range(10):
        rng = np.random.default_rng(seed)
        matches = _matches(MOUNT, rng, FINE_MATCH_NOISE_PX)
        phase, waves = rng.uniform(0.0, 2.0 * np.pi, 3), 2.0 * np.pi * rng.standard_normal((3, 2)) / 500.0
        shared = 2.0 * FINE_MATCH_NOISE_PX * np.sin(matches.pixels1 @ waves.T + phase).sum(axis=1)
        pixels2 = matches.pixels2 + shared[:, None] * [0.0, 1.0]
        chances.append(check_matches(_rig(), [replace(matches, pixels2=pixels2)]).chance)
    assert np.median(chances) > 0.05 and min(chances) > 1e-3


def test_a_step_so_wide_that_nothing_is_seen_ends_no_check(rng: np.random.Generator) -> None:
    turn = np.radians([0.05, 0.0, 0.0])
    moved = Rigid3(exp_so3(turn) @ MOUNT.rotation, exp_so3(turn) @ MOUNT.translation_mm)
    matches, looks = [_matches(moved, rng)], []

    def look(now: Monitored) -> FreshEvidence:
        looks.append(now)
        if len(looks) == 3:
            raise DegenerateError("check: the lenses see none of the matches")
        return evidence_of_matches(now, matches)

    check = evaluate_evidence(_rig(), look)
    assert (
        len(looks) >= 3 and not check.holds and check.change is not None and check.change.hypothesis.kind == "rotation"
    )
