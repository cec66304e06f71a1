"""The sentinel: quiet where nothing moved, alarmed where something did, and right about what."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from dataclasses import replace
from datetime import UTC, datetime
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from helpers.calibration_scenes import BOARD, REACH_DEG, lens, random_views

from rigkit.calibration.calibrate import calibrate
from rigkit.calibration.displaced import DisplacedCamera, lens_of
from rigkit.calibration.result import Calibration
from rigkit.cameras.base import Camera
from rigkit.cameras.compare import grid_pixels
from rigkit.core.boards import Board
from rigkit.core.detections import BoardView
from rigkit.core.errors import DegenerateError, InputError
from rigkit.geometry.rigid3 import Rigid3
from rigkit.geometry.rotation import exp_so3
from rigkit.io.calibration_file import calibration_text, load_calibration, save_calibration
from rigkit.io.history_file import HistoryEntry, add_entry, as_seen_from, load_history
from rigkit.kernels.departures import DISPLACEMENTS
from rigkit.planning.candidates import Reach
from rigkit.planning.goal import projection_goal
from rigkit.planning.information import CornerError, Knowledge
from rigkit.planning.plan import plan_views
from rigkit.report.check_page import check_page, check_words
from rigkit.report.history_page import drift_svg, history_facts, history_page
from rigkit.validation.certificate.contracts import Quantity, Task
from rigkit.validation.certificate.propagation import measured_points
from rigkit.validation.sentinel.epipolar import PairMatches, check_matches
from rigkit.validation.sentinel.evidence import FreshEvidence, FreshView, Watched
from rigkit.validation.sentinel.judge import ALARM_CHANCE, ALARM_PX, SentinelCheck, check_views, judge_evidence
from rigkit.validation.sentinel.power import FOUND
from rigkit.validation.sentinel.watch import watched_camera
from rigkit.workflows.check import fixed_text, length_costs
from rigkit.workflows.history import add_calibration, show_history
from rigkit.workflows.next_views import TASK_CELLS

NOISE_PX = 0.03
CHANGED_PX = 0.25
"""Change of the projection, rms after the best rotation: what three views show beyond doubt."""
MATCH_NOISE_PX, FINE_MATCH_NOISE_PX = 0.3, 0.07
DEPARTURE_PX, LONGER = 0.1, 1.01
POWER_DRAWS, POWER_NOISE_PX = 30, 0.04
UNSURE = 16.0
POWER_WITHIN = 0.27
"""Three standard deviations of the share of 30 that is found one time in two."""


@cache
def _held(name: str, count: int, reach: Reach | None = None) -> list[Rigid3]:
    """Return where boards are best held before a lens of `calibration_scenes`."""
    camera = lens(name)
    known = Knowledge.guessed(camera, CornerError(NOISE_PX))
    plan = plan_views(known, [BOARD], projection_goal(camera), count, reach=reach)
    return [view.cam_from_board for view in plan.views]


def _view(camera: Camera, pose: Rigid3, name: str, rng: np.random.Generator, noise_px: float = NOISE_PX) -> BoardView:
    pixels, valid = camera.project(pose.apply(BOARD.points()))
    valid &= camera.on_image(pixels)
    noisy = np.clip(pixels[valid] + noise_px * rng.standard_normal((int(valid.sum()), 2)), 0.0, None)
    return BoardView(name, BOARD, BOARD.grid()[valid], noisy, np.full(len(noisy), noise_px))


@pytest.fixture(scope="module")
def calibration() -> Calibration:
    camera, rng = lens("reg"), np.random.default_rng(2)
    views = [_view(camera, pose, f"{k}", rng) for k, pose in enumerate(_held("reg", 14))]
    return calibrate(views, camera.size_px, model="brown", degree=5, board="flat")


def _checked(calibration: Calibration, camera: Camera, rng: np.random.Generator) -> SentinelCheck:
    poses = _held("reg", 3)
    views = [FreshView(f"{k}", 0, _view(camera, pose, f"{k}", rng)) for k, pose in enumerate(poses)]
    return check_views(watched_camera(calibration, "cam"), views)


def _changed(what: Callable[[np.ndarray], np.ndarray]) -> Camera:
    camera = lens("reg")
    step = what(camera.parameters.copy()) - camera.parameters
    size = np.sqrt(step @ projection_goal(camera).weight @ step)
    return camera.with_parameters(camera.parameters + step * CHANGED_PX / size)


def test_unchanged_cameras_hold(calibration: Calibration) -> None:
    checks = [_checked(calibration, lens("reg"), np.random.default_rng(seed)) for seed in range(8)]
    assert all(check.holds for check in checks)
    # P-values of one and the same calibration's error are all alike, but none is impossible.
    assert min(check.chance for check in checks) > 1e-3
    assert "Still holds" in check_words(checks[0]).headline


@pytest.mark.parametrize(
    ("kind", "index", "by"),
    [("focus", [0, 1], 1.001), ("principal point", [2], 1.001), ("distortion", [4], 1.02)],
)
def test_what_changed_is_found_named_and_undone(
    kind: str, index: list[int], by: float, calibration: Calibration, rng: np.random.Generator
) -> None:
    def what(parameters: np.ndarray) -> np.ndarray:
        parameters[index] *= by
        return parameters

    camera = _changed(what)
    check = _checked(calibration, camera, rng)
    assert not check.holds and check.chance < 1e-3
    assert check.change is not None and check.change.cause.kind == kind
    goal = projection_goal(camera)
    before, after = (
        lens_of(c).parameters - camera.parameters for c in (check.watched.cameras[0], check.fixed.cameras[0])
    )
    assert goal.weight @ after @ after < 0.25 * (goal.weight @ before @ before)
    assert check.rms_fixed_px < check.rms_px
    assert kind.split()[0] in check_page(check, "t", {})


def test_changes_are_found_as_often_as_the_check_says() -> None:
    camera, found, said = lens("reg"), [], []
    poses, fresh = _held("reg", 10), _held("reg", 3)
    focus = camera.parameters * [1, 1, 0, 0, 0, 0, 0, 0, 0]
    for seed in range(POWER_DRAWS):
        rng = np.random.default_rng(seed)
        views = [_view(camera, pose, f"{k}", rng, POWER_NOISE_PX) for k, pose in enumerate(poses)]
        known = calibrate(views, camera.size_px, model="brown", degree=5, board="flat", folds=0)
        changed = camera.with_parameters(
            camera.parameters + focus * 0.15 / np.sqrt(focus @ projection_goal(camera).weight @ focus)
        )
        seen = [FreshView(f"{k}", 0, _view(changed, pose, f"{k}", rng, POWER_NOISE_PX)) for k, pose in enumerate(fresh)]
        check = check_views(watched_camera(known, "cam"), seen)
        (power,) = (p for p in check.powers if p.kind == "focus")
        assert power.size == 0.15
        said.append(power.chance)
        (change,) = (c for c in check.tried if c.cause.kind == "focus")
        found.append(change.chance < ALARM_CHANCE / len(check.tried))
    assert 0.2 < np.mean(said) < 0.8
    assert np.mean(found) == pytest.approx(np.mean(said), abs=POWER_WITHIN)


def test_a_check_that_holds_says_what_it_could_have_missed(calibration: Calibration) -> None:
    check = _checked(calibration, lens("reg"), np.random.default_rng(0))
    powers = {p.kind: p for p in check.powers}
    assert set(powers) == {"focus", "principal point", "distortion"}
    for power in powers.values():
        assert (power.found_from < power.size) == (power.chance > FOUND) == (power.frames == 3)
    # A narrow lens shows where its axis is, better than its focus.
    assert powers["principal point"].chance > FOUND > powers["focus"].chance
    assert "would have been found with chance" in check_words(check).sentences[-2]
    assert "rigkit plan CALIBRATION --check" in check_words(check).sentences[-1]
    # A calibration that is no surer finds no more with any number of pictures.
    vague = replace(calibration, covariance=1e4 * calibration.covariance)
    said = _checked(vague, lens("reg"), np.random.default_rng(0))
    assert all(p.frames is None and p.chance < 0.5 for p in said.powers)
    assert "the calibration is" in check_words(said).sentences[-2]
    # One from many times as many pictures would, with as many fresh ones.
    unsure = replace(calibration, covariance=UNSURE * calibration.covariance)
    powers = {p.kind: p for p in _checked(unsure, lens("reg"), np.random.default_rng(0)).powers}
    focus = powers["focus"]
    assert focus.frames is None and focus.both is not None and 1 < focus.both <= UNSURE * 4
    assert "times as many, in the calibration too" in check_page(said, "t", {})


def test_another_camera_is_explained_by_nothing(calibration: Calibration, rng: np.random.Generator) -> None:
    other = lens("reg").with_parameters(lens("reg").parameters * [1.3, 1.05, 1.0, 1.0, 2.0, 0.2, 1.0, 1.0, 1.0])
    check = _checked(calibration, other, rng)
    assert check.unexplained and not check.holds
    assert "another camera" in " ".join(check_words(check).sentences)


def test_a_view_all_of_whose_corners_stray_says_nothing(calibration: Calibration, rng: np.random.Generator) -> None:
    """Such as of a patterned box that passed for a part of the board: it leaves no pose to solve for."""
    camera, poses = lens("reg"), _held("reg", 4)
    views = [_view(camera, pose, f"{k}", rng) for k, pose in enumerate(poses)]
    box = _view(camera, poses[0], "box", rng)
    box = replace(box, pixels=np.clip(box.pixels + 12.0 * rng.standard_normal(box.pixels.shape), 0.0, [1623.0, 1239.0]))
    watched = watched_camera(calibration, "cam")
    alone = check_views(watched, [FreshView(f"{k}", 0, view) for k, view in enumerate(views)])
    beside = check_views(watched, [FreshView(f"{k}", 0, view) for k, view in enumerate([*views, box])])
    assert beside.holds and beside.rms_px == pytest.approx(alone.rms_px, rel=0.05)


def test_what_a_lens_does_beyond_its_model_is_no_change() -> None:
    """A lens that no model is, calibrated where boards were left of the middle, is quiet right of it; a longer focal
    length is found there, too."""
    camera = lens("wide")
    rng = np.random.default_rng([9, 5])
    amounts = DEPARTURE_PX * rng.normal(size=DISPLACEMENTS)

    def beyond(model: Camera) -> Camera:
        return DisplacedCamera(model.size_px, np.append(model.parameters, amounts), model, np.eye(DISPLACEMENTS))

    views, rotations, translations = random_views(
        beyond(camera), 90, rng, reach_deg=0.95 * REACH_DEG["wide"], noise_px=NOISE_PX
    )
    width = camera.size_px[0]
    left = [view for view in views if view.pixels[:, 0].max() < 0.6 * width][:14]
    right = [k for k, view in enumerate(views) if view.pixels[:, 0].min() > 0.5 * width][:3]
    known = calibrate(left, camera.size_px, model=camera.model, board="flat", folds=0)
    same = [FreshView(f"{k}", 0, views[k]) for k in right]
    longer = beyond(camera.with_parameters(camera.parameters * [LONGER, LONGER, 1, 1, 1, 1, 1, 1]))
    poses = [Rigid3(rotations[k], translations[k]) for k in right]
    other = [FreshView(f"{k}", 0, _view(longer, pose, f"{k}", rng)) for k, pose in enumerate(poses)]
    assert not check_views(watched_camera(known, "cam", beyond_model=False), same).holds
    watched = watched_camera(known, "cam")
    check, changed = check_views(watched, same), check_views(watched, other)
    assert check.holds and not changed.holds
    assert len(watched.of_models) == camera.parameters.size < watched.size
    assert np.array_equal(np.delete(changed.step, watched.of_models), np.zeros(watched.size - len(watched.of_models)))


def test_nothing_to_look_at_is_refused(calibration: Calibration) -> None:
    with pytest.raises(InputError, match="no board was found"):
        check_views(watched_camera(calibration, "cam"), [])


MOUNT = Rigid3(exp_so3(np.array([0.01, -0.08, 0.02])), [-120.0, 2.0, 3.0])
TURN_DEG = [0.02, -0.015, 0.03]
LENS_SIGMAS = [0.1, 0.1, 0.1, 0.1, 2e-5, 2e-5, 2e-5, 2e-5]


def _rig() -> Watched:
    camera = lens("wide")
    return Watched(
        names=("left", "right"),
        cameras=(camera, camera),
        cam_from_rig=(Rigid3.identity(), MOUNT),
        covariance=np.diag([*LENS_SIGMAS, *LENS_SIGMAS, *[2e-5] * 3, *[0.01] * 3]) ** 2,
        sigma_px=NOISE_PX,
        freedom=20.0,
    )


NEAR = Reach(nearest_mm=300.0)


def _rig_check(pose: Rigid3, second: Camera, rng: np.random.Generator) -> SentinelCheck:
    rig, views = _rig(), []
    for k, held in enumerate(_held("wide", 3, NEAR)):
        views.append(FreshView(f"{k}", 0, _view(rig.cameras[0], held, f"{k}", rng)))
        views.append(FreshView(f"{k}", 1, _view(second, pose @ held, f"{k}", rng)))
    return check_views(rig, views)


def test_a_rig_that_nobody_touched_holds() -> None:
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
    assert (check.change.cause.kind, check.change.cause.camera) == ("rotation", "right")
    assert check.change.amounts == pytest.approx(np.degrees(turn), abs=4.0 * float(check.change.sigmas.max()))
    assert check.change.sigmas.max() < 0.01
    # A rig's file may come from anywhere.
    assert "never held" in check_words(check).sentences[-1]


def test_a_longer_baseline_is_a_change_of_scale_or_shift(rng: np.random.Generator) -> None:
    moved = Rigid3(MOUNT.rotation, 1.01 * MOUNT.translation_mm)
    check = _rig_check(moved, lens("wide"), rng)
    assert not check.holds and check.change is not None
    assert check.change.cause.kind == "scale"
    assert check.change.amounts == pytest.approx([1.0], abs=0.1)


def _matches(pose: Rigid3, rng: np.random.Generator, noise_px: float = MATCH_NOISE_PX) -> PairMatches:
    camera = lens("wide")
    rays, valid = camera.unproject(rng.uniform([100.0, 100.0], [1500.0, 1100.0], (600, 2)))
    points = rays[valid] * rng.uniform(700.0, 4000.0, (int(valid.sum()), 1))
    pixels1, seen1 = camera.project(points)
    pixels2, seen2 = camera.project(pose.apply(points))
    both = seen1 & seen2 & camera.on_image(pixels2)
    noisy = [p[both] + noise_px * rng.standard_normal((int(both.sum()), 2)) for p in (pixels1, pixels2)]
    # One match in ten is wrong.
    wrong = rng.random(len(noisy[0])) < 0.1
    noisy[1][wrong] += rng.uniform(-60.0, 60.0, (int(wrong.sum()), 2))
    return PairMatches(0, 1, np.clip(noisy[0], 0.0, None), np.clip(noisy[1], 0.0, None))


def test_a_scene_tells_of_a_mount_without_any_board() -> None:
    quiet, named, draws = 0, 0, 3
    turn = np.radians([0.05, 0.0, 0.0])
    moved = Rigid3(exp_so3(turn) @ MOUNT.rotation, exp_so3(turn) @ MOUNT.translation_mm)
    for seed in range(draws):
        rng = np.random.default_rng(seed)
        quiet += check_matches(_rig(), [_matches(MOUNT, rng)]).holds
        alarmed = check_matches(_rig(), [_matches(moved, rng)])
        assert not alarmed.holds
        named += alarmed.change is not None and alarmed.change.cause.kind == "rotation"
    assert quiet == named == draws


def test_matches_that_say_nothing_are_told_from_those_that_say_little() -> None:
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
        information=np.full((1, rig.size, rig.size), np.inf),
        score=np.full((1, rig.size), np.inf),
        variance_px2=0.01,
        rms_px=50.0,
        expected_px=0.1,
        corners=100,
        left_out=0,
        overdispersion=1.0,
        freedom=10.0,
    )
    check = judge_evidence(rig, lambda _: far)
    assert check.unexplained and not check.holds and check.change is None
    assert "nothing that moved explains it" in check_words(check).headline
    assert HistoryEntry.of_check(check, tmp_path).verdict == "nothing that moved explains it"
    # Where nothing is off, it is the calibration's numbers that are.
    with pytest.raises(DegenerateError, match="calibration's numbers"):
        judge_evidence(rig, lambda _: replace(far, rms_px=0.1))


def test_what_a_change_of_a_rig_costs_in_a_length() -> None:
    """The old rig measures points that the changed one sees."""
    watched, task = _rig(), Task(quantity=Quantity.LENGTH, size_mm=100.0, distance_mm=700.0)
    step = np.zeros(watched.size)
    step[watched.lens(0)][:2] = 0.3
    step[watched.mount(1)] = 2e-4, 4e-4, -3e-4, 0.02, 0.0, 0.01
    now, (goal,) = watched.changed(step), length_costs(watched, task)
    rays, valid = watched.cameras[0].unproject(grid_pixels(watched.cameras[0].size_px, TASK_CELLS).reshape(-1, 2))
    points = measured_points(rays[valid], task, is_rig=True)[0]
    seen, shown = np.ones(len(points), dtype=bool), []
    for camera, pose in zip(now.cameras, now.cam_from_rig, strict=True):
        pixels, sees = camera.project(pose.apply(points))
        seen &= (sees & camera.on_image(pixels)).all(axis=1)
        shown.append(pixels)
    found = points.copy()
    for _ in range(4):
        rows, left = [], []
        for camera, pose, pixels in zip(watched.cameras, watched.cam_from_rig, shown, strict=True):
            projected, _, by_point, _ = camera.project_with_jacobians(pose.apply(found))
            rows.append(by_point @ pose.rotation)
            left.append(pixels - projected)
        J, r = np.concatenate(rows, axis=-2)[seen], np.concatenate(left, axis=-1)[seen]
        JT = np.swapaxes(J, -1, -2)
        found[seen] += np.linalg.solve(JT @ J, JT @ r[..., None])[..., 0]
    lengths = np.linalg.norm(found[seen][:, 1::2] - found[seen][:, ::2], axis=-1)
    wrong = float(np.sqrt(((lengths - task.size_mm) ** 2).mean()))
    assert goal.unit == "mm" and np.sqrt(step @ goal.weight @ step) == pytest.approx(wrong, rel=0.02)
    far = Task(quantity=Quantity.LENGTH, size_mm=90000.0, distance_mm=700.0)
    with pytest.raises(DegenerateError, match="of no two cameras"):
        length_costs(watched, far)


def test_what_a_calibration_leaves_open_is_no_other_rig() -> None:
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
    assert check.chance < 1e-9 and check.change is not None and check.change.cause.kind == "rotation"
    assert check.change.amounts == pytest.approx(np.degrees(turn), abs=4.0 * float(check.change.sigmas.max()))


@pytest.mark.parametrize("axis", range(3))
def test_wrong_matches_that_lie_alone_do_not_rename_a_change(axis: int) -> None:
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
        assert not check.holds and check.change is not None and check.change.cause.kind == "rotation"


def test_the_size_of_a_change_is_not_that_of_its_uncertainty() -> None:
    sizes = []
    for seed in range(8):
        matches = _matches(MOUNT, np.random.default_rng(seed))
        check = check_matches(_rig(), [PairMatches(0, 1, matches.pixels1[:60], matches.pixels2[:60])])
        assert check.change is not None
        sizes.append(check.change.size_px)
    # Nothing happened, and sixty matches do not say so well: of the estimates alone the median is 0.09 px.
    assert np.median(sizes) < ALARM_PX / 2.0


def test_the_correction_is_a_calibration_that_says_so(calibration: Calibration, tmp_path: Path) -> None:
    camera = _changed(lambda p: p * [1.001, 1.001, 1, 1, 1, 1, 1, 1, 1])
    check = _checked(calibration, camera, np.random.default_rng(1))
    path = tmp_path / "calibration.json"
    save_calibration(path, calibration)
    path.write_text(fixed_text(path, check))
    fixed = load_calibration(path)
    assert fixed.camera.parameters == pytest.approx(lens_of(check.fixed.cameras[0]).parameters)
    assert "focus" in fixed.verdicts[0].message
    assert fixed.covariance[0, 0] > calibration.covariance[0, 0]
    assert calibration_text(fixed) != calibration_text(calibration)


def test_the_register_grows_and_is_drawn(calibration: Calibration, tmp_path: Path) -> None:
    register = tmp_path / "cam.jsonl"
    for seed in range(3):
        check = _checked(calibration, lens("reg"), np.random.default_rng(seed))
        add_entry(register, HistoryEntry.of_check(check, tmp_path / "c.json", temperature_c=21.0))
    entries = load_history(register)
    assert len(entries) == 3 and all(entry.holds for entry in entries)
    assert set(entries[0].amounts) == {
        "focus, %", "principal point 1, px", "principal point 2, px", "distortion 1, px", "distortion 2, px",
        "distortion 3, px",
    }  # fmt: skip
    page = history_page(entries, "t", {})
    assert page.count("<svg") == 6 and "21.0" in page
    register.write_text(register.read_text() + json.dumps({"schema": "other"}) + "\n")
    with pytest.raises(InputError, match=r"line 4.*another schema"):
        load_history(register)


def test_a_register_of_months(calibration: Calibration, tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    """Two cameras, more and fewer pictures, clocks that went back, dates of other zones and files that moved."""
    check = _checked(calibration, lens("reg"), np.random.default_rng(3))
    register = tmp_path / "lab" / "register.jsonl"
    for camera, day in (("left", 3), ("right", 4), ("left", 1), ("left", 5)):
        source = as_seen_from(register, tmp_path / "lab" / camera / "calibration.json")
        add_entry(register, HistoryEntry.of_check(check, source, now=datetime(2026, 3, day, tzinfo=UTC)))
    save_calibration(tmp_path / "c.json", calibration)
    add_calibration(register, tmp_path / "c.json", tmp_path / "c.json", temperature_c=19.0)
    # Two hours east, this is before the entry of 3 March; a former version said nothing of the reference.
    older = json.loads(register.read_text().splitlines()[0]) | {"date": "2026-03-03T01:00:00+02:00"}
    del older["reference"]
    register.write_text(register.read_text() + json.dumps(older) + "\n")
    entries, _ = show_history(register, report=tmp_path / "page.html")
    assert [entry.date[5:10] for entry in entries[:5]] == ["03-01", "03-03", "03-03", "03-04", "03-05"]
    assert entries[1].date.endswith("+02:00") and entries[-1].reference == "../c.json" == entries[-1].source
    assert {entry.source for entry in entries[:5]} == {"left/calibration.json", "right/calibration.json"}
    assert "2 entries follow one of a later day" in caplog.text
    page = (tmp_path / "page.html").read_text()
    assert history_facts(entries).passed and "of each file holds" in history_facts(entries).headline
    alarm = replace(entries[3], holds=False)
    assert "of right/calibration.json is an alarm" in history_facts([*entries[:3], alarm, *entries[4:]]).headline
    # The amounts of one camera are no drift of another.
    assert page.count("<svg") == 18 and page.count("left/calibration.json: focus, %") == 1


def test_every_entry_has_its_own_control_limits(calibration: Calibration) -> None:
    check = _checked(calibration, lens("reg"), np.random.default_rng(3))
    one = HistoryEntry.of_check(check, Path("c.json"), now=datetime(2026, 3, 1, tzinfo=UTC))
    value, sigma = one.amounts["focus, %"]
    unsure = replace(one, date="2026-03-09T00:00:00Z", amounts={"focus, %": (value, 4.0 * sigma)})
    drawn = re.findall(r'<path d="M([^"]*)"[^>]*dasharray="5 4"', drift_svg([one, unsure], "focus, %"))
    heights = [float(point.split()[1]) for point in drawn[0].split("L")]
    assert len(drawn) == 2 and heights[0] == heights[1] > heights[2] == heights[3]
    middle = 0.5 * (heights[0] + float(drawn[1].split("L")[0].split()[1]))
    assert middle - heights[2] == pytest.approx(4.0 * (middle - heights[0]), abs=0.2)


def test_a_lens_that_changed_in_several_ways_is_told_by_what_it_does(calibration: Calibration) -> None:
    def several(p: np.ndarray) -> np.ndarray:
        return p * [1.004, 1.004, 1, 1, 1.1, 1, 1, 1, 1] + [0, 0, 9.0, -7.0, 0, 0, 0, 0, 0]

    usual = lens("reg").parameters
    much = lens("reg").with_parameters(usual + 6.0 * (_changed(several).parameters - usual))
    check = _checked(calibration, much, np.random.default_rng(1))
    assert check.change is not None and check.change.cause.kind == "lens" and not check.holds
    words = check_words(check)
    assert re.search(r"changed in several ways; [\d.]+ px, [\d.]+ mm at 1 m$", words.headline)
    assert re.search(r"\d+% of what is seen is explained by this alone: the ", words.sentences[1])


def test_the_same_calibration_again_is_no_change(calibration: Calibration, tmp_path: Path) -> None:
    """What rounding leaves of no difference at all is of no importance, however little was expected."""
    save_calibration(tmp_path / "c.json", calibration)
    add_calibration(tmp_path / "cam.jsonl", tmp_path / "c.json", tmp_path / "c.json")
    (entry,) = load_history(tmp_path / "cam.jsonl")
    assert entry.holds and entry.verdict == "holds"
    assert entry.chance > 0.5


def test_what_moves_nothing_is_no_other_camera(calibration: Calibration) -> None:
    """Rounding alone can leave many times as much as expected where that is nothing, as in the same camera again."""
    check = _checked(calibration, lens("reg"), np.random.default_rng(0))
    rounded = replace(check, chance=1.0, expected_px=4e-14, rms_px=4e-14, rms_fixed_px=2e-12)
    assert rounded.holds and not rounded.unexplained
    assert replace(check, expected_px=0.03, rms_fixed_px=0.3).unexplained


def test_a_declared_board_of_another_size_is_accepted(calibration: Calibration, rng: np.random.Generator) -> None:
    camera, name = lens("reg"), calibration.boards[0].board_id
    larger = Board(name, 12, 9, 20.0, 20.0)
    known = Knowledge.guessed(camera, CornerError(NOISE_PX))
    views = []
    for k, proposal in enumerate(plan_views(known, [larger], projection_goal(camera), 3).views):
        pixels, _ = camera.project(proposal.cam_from_board.apply(larger.points()))
        noisy = pixels + NOISE_PX * rng.standard_normal(pixels.shape)
        view = BoardView(f"{k}", larger, larger.grid(), noisy, np.full(len(noisy), NOISE_PX))
        views.append(FreshView(f"{k}", 0, view))
    assert check_views(watched_camera(calibration, "cam"), views).holds


def test_images_that_disagree_are_judged_more_carefully(calibration: Calibration) -> None:
    camera = _changed(lambda p: p * [1.001, 1.001, 1, 1, 1, 1, 1, 1, 1])
    sure = _checked(calibration, camera, np.random.default_rng(1))
    disagreeing = replace(calibration, overdispersion=4.0)
    unsure = _checked(disagreeing, camera, np.random.default_rng(1))
    assert sure.chance < 1e-3 and unsure.chance > 1e3 * sure.chance
