"""`rigkit check`: no false alarms, alarms after changes, and the right name of the change."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from helpers.calibration_scenes import BOARD, REACH_DEG, lens, noisy_view, random_views
from helpers.monitoring_scenes import NOISE_PX, best_held, changed_lens, checked, poses_held
from scipy.special import fdtrc, ndtr

from rigkit.calibration.calibrate import calibrate
from rigkit.calibration.certainty.departures import with_own_noise
from rigkit.calibration.certainty.displaced import DisplacedCamera, lens_of
from rigkit.calibration.result import Calibration
from rigkit.cameras.base import Camera
from rigkit.cameras.registry import camera_model
from rigkit.core.arrays import scaled_pinv
from rigkit.core.boards import Board
from rigkit.core.detections import BoardView
from rigkit.core.errors import InputError
from rigkit.geometry.rigid3 import Rigid3
from rigkit.geometry.rotation import exp_so3
from rigkit.io.calibrations.calibration_file import calibration_text, load_calibration, save_calibration
from rigkit.io.calibrations.history_file import load_history
from rigkit.kernels.departures import DISPLACEMENTS
from rigkit.planning.goal import projection_goal
from rigkit.report.pages.check_page import change_svg, check_facts, check_page
from rigkit.validation.monitoring.evidence import FreshView, Monitored, evidence_of
from rigkit.validation.monitoring.power import FOUND
from rigkit.validation.monitoring.verdict import ALARM_CHANCE, check_views
from rigkit.validation.monitoring.watch import monitored_camera
from rigkit.validation.monitoring.whitened import Whitened
from rigkit.workflows.checks.check import fixed_text
from rigkit.workflows.checks.history import add_to_history

DEPARTURE_PX, LONGER = 0.1, 1.01
POWER_DRAWS, POWER_NOISE_PX = 30, 0.04
UNSURE = 16.0
POWER_WITHIN = 0.27
"""Three standard deviations of the share of 30 that is found one time in two."""


def test_unchanged_cameras_hold(calibration: Calibration) -> None:
    checks = [checked(calibration, lens("reg"), np.random.default_rng(seed)) for seed in range(8)]
    assert all(check.holds for check in checks)
    # P-values of one and the same calibration's error are all alike, but none is impossible.
    assert min(check.chance for check in checks) > 1e-3
    assert check_facts(checks[0]).headline.startswith("Still holds (")
    blind = replace(checks[0], powers=tuple(replace(power, chance=0.1) for power in checks[0].powers))
    assert check_facts(blind).headline.startswith("Still holds, as far as these images show (")
    assert re.search(r"drawn [125]0* times as long", change_svg(checks[0], 0))


def test_sigmas_of_amounts_tell_the_same_as_their_chance(calibration: Calibration) -> None:
    """Of a single amount, two of them have the p-value of two of a normal distribution."""
    two = 2.0 * float(ndtr(-2.0))
    tried = [c for k in range(8) for c in checked(calibration, lens("reg"), np.random.default_rng(k)).tried]
    single = [c for c in tried if c.amounts.size == 1]
    assert single and all((abs(c.amounts[0]) > 2.0 * c.sigmas[0]) == (c.chance < two) for c in single)
    known = replace(single[0], freedom=5.0)
    edge = fdtrc(1, known.freedom, (2.0 * known.sigmas[0]) ** 2 / known.covariance[0, 0])
    assert edge == pytest.approx(two, rel=1e-6)


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

    camera = changed_lens(what)
    check = checked(calibration, camera, rng)
    assert not check.holds and check.chance < 1e-3
    assert check.change is not None and check.change.hypothesis.kind == kind
    goal = projection_goal(camera)
    before, after = (
        lens_of(c).parameters - camera.parameters for c in (check.monitored.cameras[0], check.fixed.cameras[0])
    )
    assert goal.weight @ after @ after < 0.25 * (goal.weight @ before @ before)
    assert check.rms_fixed_px < check.rms_px
    assert kind.split()[0] in check_page(check, "t", {})


def test_changes_are_found_as_often_as_the_check_says() -> None:
    camera, found, printed = lens("reg"), [], []
    poses, fresh = poses_held("reg", 10), poses_held("reg", 3)
    focus = camera.parameters * [1, 1, 0, 0, 0, 0, 0, 0, 0]
    for seed in range(POWER_DRAWS):
        rng = np.random.default_rng(seed)
        views = [noisy_view(camera, pose, f"{k}", rng, POWER_NOISE_PX) for k, pose in enumerate(poses)]
        known = calibrate(views, camera.size_px, model="brown", degree=5, board="flat", folds=0)
        changed = camera.with_parameters(
            camera.parameters + focus * 0.15 / np.sqrt(focus @ projection_goal(camera).weight @ focus)
        )
        seen = [
            FreshView(f"{k}", 0, noisy_view(changed, pose, f"{k}", rng, POWER_NOISE_PX)) for k, pose in enumerate(fresh)
        ]
        check = check_views(monitored_camera(known, "cam"), seen)
        (power,) = (p for p in check.powers if p.kind == "focus")
        assert power.size == 0.15
        printed.append(power.chance)
        (change,) = (c for c in check.tried if c.hypothesis.kind == "focus")
        found.append(change.chance < ALARM_CHANCE / len(check.tried))
    assert 0.2 < np.mean(printed) < 0.8
    assert np.mean(found) == pytest.approx(np.mean(printed), abs=POWER_WITHIN)


def test_a_check_that_holds_says_what_it_could_have_missed(calibration: Calibration) -> None:
    check = checked(calibration, lens("reg"), np.random.default_rng(0))
    powers = {p.kind: p for p in check.powers}
    assert set(powers) == {"focus", "principal point", "distortion"}
    for power in powers.values():
        assert (power.found_from < power.size) == (power.chance > FOUND) == (power.frames == 3)
    # A narrow lens shows where its axis is, better than its focus.
    assert powers["principal point"].chance > FOUND > powers["focus"].chance
    assert "would have been detected with probability" in check_facts(check).sentences[-2]
    assert "rigkit plan CALIBRATION --check" in check_facts(check).sentences[-1]
    # A calibration that is no surer finds no more with any number of pictures.
    vague = replace(calibration, covariance=1e4 * calibration.covariance)
    printed = checked(vague, lens("reg"), np.random.default_rng(0))
    assert all(p.frames is None and p.chance < 0.5 for p in printed.powers)
    assert "the calibration is" in check_facts(printed).sentences[-2]
    # One from many times as many pictures would, with as many fresh ones.
    unsure = replace(calibration, covariance=UNSURE * calibration.covariance)
    powers = {p.kind: p for p in checked(unsure, lens("reg"), np.random.default_rng(0)).powers}
    focus = powers["focus"]
    assert focus.frames is None and focus.both is not None and 1 < focus.both <= UNSURE * 4
    assert "times as many, also in the calibration" in check_page(printed, "t", {})


def test_another_camera_is_explained_by_nothing(calibration: Calibration, rng: np.random.Generator) -> None:
    other = lens("reg").with_parameters(lens("reg").parameters * [1.3, 1.05, 1.0, 1.0, 2.0, 0.2, 1.0, 1.0, 1.0])
    check = checked(calibration, other, rng)
    assert check.unexplained and not check.holds
    assert "another camera" in " ".join(check_facts(check).sentences)


def test_a_change_beyond_the_range_of_the_lens_model_is_none_that_explains(rng: np.random.Generator) -> None:
    """As a step from the linear solution is in REAL pairs of bouguet and bumblebee2."""
    size_px, (poses, sigmas) = lens("reg").size_px, (poses_held("reg", 3), [0.1, 0.1, 0.1, 0.1, 1e-3, 1e-3])
    flat = camera_model("eucm")(size_px, np.array([1200.0, 1200.0, 811.0, 619.0, 0.05, 1.0]))
    other = camera_model("brown")(size_px, np.array([1200.0, 1200.0, 811.0, 619.0, 0.15, 0.0, 0.0, 0.0, 0.0]))
    known = Monitored(
        names=("cam",),
        cameras=(flat,),
        cam_from_rig=(Rigid3.identity(),),
        covariance=np.diag(sigmas) ** 2,
        sigma_px=NOISE_PX,
    )
    views = [FreshView(f"{k}", 0, noisy_view(other, pose, f"{k}", rng, NOISE_PX)) for k, pose in enumerate(poses)]
    check = check_views(known, views)
    assert check.unexplained and not check.holds
    np.testing.assert_allclose(check.fixed.cameras[0].parameters, flat.parameters + check.step, rtol=1e-12)


def test_a_view_all_of_whose_corners_stray_says_nothing(calibration: Calibration, rng: np.random.Generator) -> None:
    """Such as of a patterned box that passed for a part of the board: it leaves no pose to solve for."""
    camera, poses = lens("reg"), poses_held("reg", 4)
    views = [noisy_view(camera, pose, f"{k}", rng, NOISE_PX) for k, pose in enumerate(poses)]
    box = noisy_view(camera, poses[0], "box", rng, NOISE_PX)
    box = replace(box, pixels=np.clip(box.pixels + 12.0 * rng.standard_normal(box.pixels.shape), 0.0, [1623.0, 1239.0]))
    monitored = monitored_camera(calibration, "cam")
    alone = check_views(monitored, [FreshView(f"{k}", 0, view) for k, view in enumerate(views)])
    beside = check_views(monitored, [FreshView(f"{k}", 0, view) for k, view in enumerate([*views, box])])
    assert beside.holds and beside.rms_px == pytest.approx(alone.rms_px, rel=0.05)


def test_model_inadequacy_raises_no_alarm() -> None:
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
    other = [FreshView(f"{k}", 0, noisy_view(longer, pose, f"{k}", rng, NOISE_PX)) for k, pose in enumerate(poses)]
    assert not check_views(monitored_camera(known, "cam", beyond_model=False), same).holds
    monitored = monitored_camera(known, "cam")
    check, changed = check_views(monitored, same), check_views(monitored, other)
    assert check.holds and not changed.holds
    assert len(monitored.of_models) == camera.parameters.size < monitored.layout.count
    assert np.array_equal(
        np.delete(changed.step, monitored.of_models), np.zeros(monitored.layout.count - len(monitored.of_models))
    )


def test_nothing_to_look_at_is_refused(calibration: Calibration) -> None:
    with pytest.raises(InputError, match="no board was found"):
        check_views(monitored_camera(calibration, "cam"), [])


def test_the_correction_is_a_calibration_that_says_so(calibration: Calibration, tmp_path: Path) -> None:
    camera = changed_lens(lambda p: p * [1.001, 1.001, 1, 1, 1, 1, 1, 1, 1])
    check = checked(calibration, camera, np.random.default_rng(1))
    path = tmp_path / "calibration.json"
    save_calibration(path, calibration)
    path.write_text(fixed_text(path, check))
    fixed = load_calibration(path)
    assert fixed.camera.parameters == pytest.approx(lens_of(check.fixed.cameras[0]).parameters)
    assert "focus" in fixed.verdicts[0].message
    assert fixed.covariance[0, 0] > calibration.covariance[0, 0]
    assert calibration_text(fixed) != calibration_text(calibration)


def test_a_lens_changed_in_several_ways_is_described_by_its_displacement(calibration: Calibration) -> None:
    def several(p: np.ndarray) -> np.ndarray:
        return p * [1.004, 1.004, 1, 1, 1.1, 1, 1, 1, 1] + [0, 0, 9.0, -7.0, 0, 0, 0, 0, 0]

    typical = lens("reg").parameters
    much = lens("reg").with_parameters(typical + 6.0 * (changed_lens(several).parameters - typical))
    check = checked(calibration, much, np.random.default_rng(1))
    assert check.change is not None and check.change.hypothesis.kind == "lens" and not check.holds
    words = check_facts(check)
    assert re.search(
        r"several parameters of the lens of the camera changed; [\d.]+ px, [\d.]+ mm at 1 m$", words.headline
    )
    assert re.search(r"\d+% of it is explained by this alone: the ", words.sentences[1])


def test_the_same_calibration_again_is_no_change(calibration: Calibration, tmp_path: Path) -> None:
    """What rounding leaves of no difference at all is of no importance, however little was expected."""
    save_calibration(tmp_path / "c.json", calibration)
    add_to_history(tmp_path / "cam.jsonl", tmp_path / "c.json", tmp_path / "c.json")
    (entry,) = load_history(tmp_path / "cam.jsonl")
    assert entry.holds and entry.verdict == "holds"
    assert entry.chance > 0.5


def test_rounding_errors_raise_no_alarm(calibration: Calibration) -> None:
    """Rounding alone can leave many times as much as expected where that is nothing, as in the same camera again."""
    check = checked(calibration, lens("reg"), np.random.default_rng(0))
    rounded = replace(check, chance=1.0, expected_px=4e-14, rms_px=4e-14, rms_fixed_px=2e-12)
    assert rounded.holds and not rounded.unexplained
    assert replace(check, expected_px=0.03, rms_fixed_px=0.3).unexplained


def test_a_declared_board_of_another_size_is_accepted(calibration: Calibration, rng: np.random.Generator) -> None:
    camera, name = lens("reg"), calibration.boards[0].board_id
    larger = Board(name, 12, 9, 20.0, 20.0)
    views = []
    for k, pose in enumerate(best_held(camera, larger, 3, NOISE_PX)):
        views.append(FreshView(f"{k}", 0, noisy_view(camera, pose, f"{k}", rng, NOISE_PX, board=larger)))
    assert check_views(monitored_camera(calibration, "cam"), views).holds


def test_images_that_disagree_are_judged_more_carefully(calibration: Calibration) -> None:
    camera = changed_lens(lambda p: p * [1.001, 1.001, 1, 1, 1, 1, 1, 1, 1])
    sure = checked(calibration, camera, np.random.default_rng(1))
    disagreeing = replace(calibration, overdispersion=4.0)
    unsure = checked(disagreeing, camera, np.random.default_rng(1))
    assert sure.chance < 1e-3 and unsure.chance > 1e3 * sure.chance


def test_a_board_that_passed_for_another_lens_is_no_change(rng: np.random.Generator) -> None:
    """Boards that were never turned leave open whether pixels or squares are longer one way. Three standard deviations
    of both together are three of the check, also where the board is now turned by a quarter."""

    def held(turn_rad: float, tilts: list[tuple[float, float]]) -> list[Rigid3]:
        turned = [exp_so3(np.array([x, y, 0.0])) @ exp_so3(np.array([0.0, 0.0, turn_rad])) for x, y in tilts]
        return [Rigid3(turn, np.array([0.0, 0.0, 700.0]) - turn @ BOARD.points().mean(axis=0)) for turn in turned]

    before = [(x, y) for x in (-0.3, 0.0, 0.3) for y in (-0.3, 0.1, 0.3)]
    views = [noisy_view(lens("reg"), pose, f"{k}", rng, NOISE_PX) for k, pose in enumerate(held(0.0, before))]
    known = calibrate(views, lens("reg").size_px, model="brown", degree=5, board="warp", folds=0)
    monitored = monitored_camera(known, "cam")
    aspect = monitored.layout.shape.start
    sigma = float(np.sqrt(monitored.covariance[aspect, aspect]))
    assert sigma > 3e-4
    true = monitored.changed(3.0 * monitored.covariance[:, aspect] / sigma)
    fresh = []
    for k, pose in enumerate(held(0.5 * np.pi, [(0.5, 0.0), (0.0, 0.5), (-0.5, 0.3)])):
        pixels, _ = true.cameras[0].project(pose.apply(true.boards_mm[BOARD.board_id]))
        view = BoardView(f"{k}", BOARD, BOARD.grid(), pixels, np.full(BOARD.corner_count, NOISE_PX))
        fresh.append(FreshView(view.image, 0, view))
    seen = Whitened.of(monitored, evidence_of(monitored, fresh))
    assert 1.0 < seen.score @ np.linalg.solve(seen.covariance, seen.score) < 3.0**2 * 1.05
    # The correction for it leaves nothing.
    assert evidence_of(true, fresh).rms_px < 1e-3 < evidence_of(monitored, fresh).rms_px


def test_quoted_sigmas_of_a_measured_board_are_widened_as_those_of_the_lens(rng: np.random.Generator) -> None:
    views = [noisy_view(lens("reg"), pose, f"{k}", rng, NOISE_PX) for k, pose in enumerate(poses_held("reg", 4))]
    known = calibrate(views, lens("reg").size_px, model="pinhole", board="warp", folds=0)
    given_lens = []
    for quoted in (False, True):
        monitored = monitored_camera(known, "cam", quoted=quoted)
        whole, n = monitored.covariance, monitored.layout.shape.start
        given_lens.append(whole[n:, n:] - whole[n:, :n] @ scaled_pinv(whole[:n, :n]) @ whole[:n, n:])
    widening = with_own_noise(known).widening
    assert widening > 1.05
    assert np.diag(given_lens[1]) == pytest.approx(widening**2 * np.diag(given_lens[0]), rel=1e-6)
