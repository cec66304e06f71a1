"""Cameras without a common trigger in front of a moving board: lags and row-by-row readout are solved for."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from helpers.calibration_scenes import BOARD, SIZE, lens

from rigkit.calibration.rig import calibrate
from rigkit.calibration.rig.calibrate import calibrate_rig, heldout_rms
from rigkit.calibration.rig.certainty.solved_again import readout_error
from rigkit.calibration.rig.joint import JointRig, solve_jointly
from rigkit.calibration.rig.result import RigCalibration
from rigkit.calibration.rig.solving import lags
from rigkit.calibration.rig.solving.exposure_times import POINTS
from rigkit.calibration.rig.solving.lags import TIMINGS, Timing, cost_of_own_times, times_of, with_trajectories
from rigkit.calibration.rig.solving.shutters import readout_errors_of_speeds, readout_steps, with_longer_readouts
from rigkit.calibration.rig.solving.state import RigObservations, RigState
from rigkit.core.arrays import FloatArray
from rigkit.core.detections import BoardView
from rigkit.core.progress import Progress, silent
from rigkit.geometry.rigid3 import Rigid3
from rigkit.geometry.rotation import exp_so3
from rigkit.io.calibrations.rig_file import load_saved_rig, rig_text

MOUNT = Rigid3(exp_so3(np.array([0.01, -0.08, 0.005])), [-120.0, 3.0, 8.0])
FRAMES, NOISE_PX = 12, 0.03
RATES = np.array([[0.9, 0.5, 0.7], [0.4, 1.1, 0.6]])
"""Of turns and shifts about three axes, rad a frame."""
LEFT = 0.3
"""Of the error of a baseline without lags so much is left at most: of 4.1, 23.0 and 6.8 mm it was 0.09, 3.5 and 1.0,
from one frame to the next boards that turn by a radian go on by more than a polynomial tells."""


def poses(times: FloatArray, seed: int) -> tuple[FloatArray, FloatArray]:
    """Return rotations (N, 3, 3) and translations (N, 3) of a board in hand at `times` (N,): from one frame's time to
    the next about 60 mm and 15 degrees further."""
    phases = np.random.default_rng(seed).uniform(0.0, 6.0, (2, 3))
    turns, shifts = np.moveaxis(np.sin(RATES * times[:, None, None] + phases), 1, 0)
    turn = exp_so3(turns * [0.4, 0.4, 0.8])
    return turn, shifts * [70.0, 50.0, 120.0] + [0.0, 0.0, 600.0] - turn @ BOARD.points().mean(axis=0)


def pose(time: float, seed: int) -> Rigid3:
    turn, shift = poses(np.array([time]), seed)
    return Rigid3(turn[0], shift[0])


def rig_of(
    lag: float,
    seed: int,
    *,
    jitter: float = 0.0,
    time: Callable[[int], float] = float,
    name: Callable[[int], str] = str,
    noise_px: float = NOISE_PX,
    readout: float = 0.0,
) -> RigCalibration:
    """Return a rig whose second camera sees all that much of a frame's time later, give or take `jitter`; frame k is of
    the `time` and has the `name` that these return, and takes the `readout` to be read."""
    rng = np.random.default_rng(seed)
    cameras = {"left": (Rigid3.identity(), 0.0), "right": (MOUNT, lag)}
    views: dict[str, list[tuple[str, BoardView]]] = {name: [] for name in cameras}
    for k in range(FRAMES):
        for side, (mount, late) in cameras.items():
            late = late + jitter * rng.normal() if late else late
            pixels, _ = lens("reg").project((mount @ pose(time(k) + late, seed)).apply(BOARD.points()))
            for _ in range(3 if readout else 0):
                read = time(k) + late + readout * (pixels[:, 1] - 0.5 * (SIZE[1] - 1.0)) / SIZE[1]
                turn, shift = poses(read, seed)
                corners = np.einsum("nij,nj->ni", turn, BOARD.points()) + shift
                pixels, _ = lens("reg").project(mount.apply(corners))
            seen = lens("reg").on_image(pixels)
            noisy = np.clip(pixels[seen] + noise_px * rng.normal(size=(int(seen.sum()), 2)), 0.0, np.array(SIZE) - 1.0)
            view = BoardView(f"{side}{k}", BOARD, BOARD.grid()[seen], noisy, np.full(len(noisy), noise_px))
            views[side].append((name(k), view))
    return calibrate_rig(views, dict.fromkeys(cameras, SIZE), model="brown", folds=0)


def off_mm(rig: RigCalibration) -> tuple[float, float]:
    """Return the error of the baseline and its standard deviation, mm."""
    length, sigma = rig.baseline_mm("left", "right")
    return length - float(np.linalg.norm(MOUNT.translation_mm)), sigma


def test_a_lag_is_solved_for(tmp_path: Path) -> None:
    for seed, (lag, without_mm) in enumerate(((0.05, 4.1), (-0.2, 23.0))):
        rig = rig_of(lag, seed)
        found, (off, sigma) = rig.lags["right"], off_mm(rig)
        assert abs(found.frames - lag) < 3.0 * found.sigma < abs(lag)
        assert abs(off) < min(3.0 * sigma, LEFT * without_mm)
        when = "after" if lag > 0.0 else "before"
        assert any(f"frame periods {when} 'left'" in printed.message for printed in rig.verdicts)
    (tmp_path / "rig.json").write_text(rig_text(rig))
    first, second = json.loads((tmp_path / "rig.json").read_text())["cameras"]
    assert "lag" not in first
    assert second["lag"] == {"frames": found.frames, "sigma": found.sigma, "scatter": found.scatter}
    assert list(load_saved_rig(tmp_path / "rig.json").cameras) == ["left", "right"]


def test_pictures_have_times_of_their_own() -> None:
    """A camera that runs freely."""
    rig = rig_of(0.1, 1, jitter=0.05)
    assert rig.lags["right"].scatter == pytest.approx(0.05, rel=0.5)
    assert abs(rig.lags["right"].frames - 0.1) < 3.0 * rig.lags["right"].sigma
    assert abs(off_mm(rig)[0]) < LEFT * 6.8


def test_a_camera_that_runs_freely_and_lags_by_nothing_on_average(monkeypatch: pytest.MonkeyPatch) -> None:
    """Its scatter alone tells; a single round is near the end."""
    monkeypatch.setattr(lags, "MAX_ROUNDS", 1)
    free = rig_of(1e-9, 2, jitter=0.1)
    assert free.lags["right"].scatter == pytest.approx(0.1, rel=0.5)
    assert abs(off_mm(free)[0]) < 3.0 * off_mm(free)[1]


def test_images_are_read_row_by_row(tmp_path: Path) -> None:
    """Without that the baseline is 0.8 mm off, 16 of the standard deviations."""
    rig = rig_of(0.05, 0, readout=0.05, time=lambda k: 0.5 * k)
    assert list(rig.readouts) == ["left", "right"]
    for found in rig.readouts.values():
        assert abs(found.frames - 0.1) < 3.0 * found.sigma < 0.01
    off, sigma = off_mm(rig)
    assert abs(off) < 3.0 * sigma < 0.2
    assert any("rolling shutter" in printed.message for printed in rig.verdicts)
    assert not any("not exactly synchronised" in printed.message for printed in rig.verdicts)
    (tmp_path / "rig.json").write_text(rig_text(rig))
    cameras = json.loads((tmp_path / "rig.json").read_text())["cameras"]
    assert [camera["readout"]["frames"] for camera in cameras] == [own.frames for own in rig.readouts.values()]
    assert list(load_saved_rig(tmp_path / "rig.json").cameras) == ["left", "right"]


@pytest.mark.parametrize("best", TIMINGS)
def test_timing_that_predicts_worse_is_left_out(best: Timing, monkeypatch: pytest.MonkeyPatch) -> None:
    def solved(views: Any, progress: Progress, known: None, timing: Timing = "readouts") -> Any:
        return SimpleNamespace(timing=timing)

    def heldout(joint: JointRig, folds: int) -> tuple[float, tuple[float, ...]]:
        return (0.2 if joint.timing == best else 0.3), (0.1, 0.1)

    monkeypatch.setattr(calibrate, "solve_jointly", solved)
    monkeypatch.setattr(calibrate, "heldout_rms", heldout)
    every: Any = None
    joint, (rms, _) = calibrate._best_timing(every, None, 5, silent)
    assert joint.timing == best and rms == 0.2


def test_without_heldout_errors_the_rig_is_solved_once(monkeypatch: pytest.MonkeyPatch) -> None:
    solved = list[Timing]()

    def counted(*args: Any, **options: Any) -> JointRig:
        joint = solve_jointly(*args, **options)
        solved.append(joint.timing)
        return joint

    monkeypatch.setattr("rigkit.calibration.rig.calibrate.solve_jointly", counted)
    assert rig_of(0.05, 0).lags
    assert solved == ["lags"]


@cache
def joint_with_readouts(seed: int) -> JointRig:
    """Return the solution of boards in hand whose images are read row by row."""
    joints = list[JointRig]()

    def kept(joint: JointRig, folds: int) -> tuple[None, tuple[None, None]]:
        joints.append(joint)
        return None, (None, None)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("rigkit.calibration.rig.calibrate.heldout_rms", kept)
        rig_of(0.05, seed, readout=0.05, time=lambda k: 0.5 * k)
    return joints[0]


def test_lags_are_all_that_is_solved_for_where_no_more_is_asked() -> None:
    joint = joint_with_readouts(0)
    again = solve_jointly(joint.views, silent, timing="lags")
    assert joint.timing == "readouts" and again.timing == "lags"


def test_readouts_are_solved_for_until_they_settle() -> None:
    """A step holds the rig, which has followed the error of the readouts: most of it is left."""
    joint = joint_with_readouts(0)
    step, sigma, _ = readout_steps(joint.observations, joint.solution.state)
    assert (np.abs(step) <= 0.1 * sigma).all()


@pytest.mark.parametrize("reach", [(0.2, 0.5), (1.0, 2.4), (2.2, 2.4)])
def test_steps_of_readouts_that_fall_short_or_go_too_far_settle(
    reach: tuple[float, float], monkeypatch: pytest.MonkeyPatch
) -> None:
    """A step takes `reach` times the error of each camera's readout away: with more than two it grows."""
    joint, asked = joint_with_readouts(0), np.array([0.1, -0.05])

    def steps(observations: RigObservations, state: RigState) -> tuple[FloatArray, FloatArray, FloatArray]:
        assert state.exposures is not None
        return np.array(reach) * (asked - state.exposures.readouts), np.full(2, 1e-3), np.full(2, 10.0)

    monkeypatch.setattr(lags, "readout_steps", steps)
    monkeypatch.setattr(lags, "with_longer_readouts", lambda observations, state, step: observations)
    monkeypatch.setattr(lags, "_solved_again", lambda observations, lagging, *_, **__: lagging)
    _, found = lags._with_readouts(joint.observations, joint.solution, joint.sigma_px, joint.times)
    assert found.state.exposures is not None
    assert (np.abs(found.state.exposures.readouts - asked) * np.array(reach) <= 1e-4).all()


def test_sigmas_of_readouts_count_errors_of_speeds() -> None:
    """Boards that swing within a few frames are faster or slower than a polynomial, in all residuals alike."""
    joint = joint_with_readouts(0)
    observations, state = joint.observations, joint.solution.state
    assert state.exposures is not None
    coarse = with_trajectories(state.exposures, state, observations, joint.times, POINTS - 1)
    by_speeds = readout_errors_of_speeds(observations, state, replace(state, exposures=coarse))
    assert (readout_errors_of_speeds(observations, state, state) == 0.0).all()
    assert (readout_error(joint)[1] > np.hypot(readout_steps(observations, state)[1], by_speeds)).all()
    assert (by_speeds > 0.0).all()


def test_heldout_frames_do_not_choose_their_readouts() -> None:
    """Readouts of each fold are those of the other frames: one that a single frame asks for predicts it badly."""
    joint = joint_with_readouts(0)
    assert joint.timing == "readouts"
    found, _ = heldout_rms(joint, 5)
    state = joint.solution.state
    assert state.exposures is not None
    # Corners, and the readouts known for them, that are wrong alike in all frames: the other frames set them right.
    wrong = np.full(2, 0.02)
    exposures = replace(state.exposures, readouts=state.exposures.readouts + wrong)
    moved = replace(
        joint,
        observations=with_longer_readouts(joint.observations, state, wrong),
        solution=replace(joint.solution, state=replace(state, exposures=exposures)),
    )
    again, _ = heldout_rms(moved, 5)
    assert found is not None and again is not None
    assert again < 1.3 * found


def test_times_fitted_to_heldout_frames_cost_what_predicting_them_would() -> None:
    """The cost grows by the squares of the times under their prior, and is not zero where they are."""
    joints = list[JointRig]()

    def kept(joint: JointRig, folds: int) -> tuple[None, tuple[None, None]]:
        joints.append(joint)
        return None, (None, None)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("rigkit.calibration.rig.calibrate.heldout_rms", kept)
        rig_of(0.1, 1, jitter=0.05)
    (joint,) = joints
    exposures = joint.solution.state.exposures
    assert joint.timing == "lags" and exposures is not None
    free = np.isfinite(exposures.information)
    count = int(free.sum())
    assert count > FRAMES // 2

    def cost(times: float) -> float:
        state = replace(joint.solution.state, exposures=replace(exposures, own=times * exposures.own))
        return cost_of_own_times(joint.observations, state, joint.sigma_px)

    squares = float((exposures.information[free] * exposures.own[free] ** 2).sum())
    assert squares > count * 0.3 * joint.sigma_px**2
    # Positions and speeds change a little with the times, and with them what fitting gains by chance.
    assert cost(1.0) - cost(0.0) == pytest.approx(squares, rel=0.05)
    assert cost(0.0) > 0.5 * count * joint.sigma_px**2
    assert cost_of_own_times(joint.observations, replace(joint.solution.state, exposures=None), 1.0) == 0.0


def test_cameras_of_one_moment_have_no_lag() -> None:
    rigs = [rig_of(0.0, seed) for seed in range(3)]
    assert not any(rig.lags or rig.readouts for rig in rigs)
    assert max(abs(off / sigma) for off, sigma in map(off_mm, rigs)) < 3.0


WRONG = {
    "order": ({}, {"name": lambda k: str(7 * k % FRAMES)}),
    "far apart": ({"time": lambda k: 100.7 * k}, {}),
    "turning back between two frames": ({"time": lambda k: k * np.pi / 0.45}, {}),
}


@pytest.mark.parametrize("seed", [0, *(pytest.param(seed, marks=pytest.mark.thorough) for seed in (1, 2))])
@pytest.mark.parametrize("what", WRONG)
def test_a_wrong_frame_order_or_jerky_motion_gives_no_false_lag(what: str, seed: int) -> None:
    """Frames in another order than they were taken in, and motion that frames do not follow."""
    rig = rig_of(0.05, seed, **WRONG[what][0], **WRONG[what][1])  # type: ignore[arg-type]
    off, sigma = off_mm(rig)
    assert abs(off) < 4.0 * sigma
    for own in rig.lags.values():
        assert abs(own.frames) < 0.05 + 3.0 * own.sigma


def test_times_come_from_numbers_or_from_order() -> None:
    def times(*names: str) -> list[float]:
        keys = [(name, "board") for name in names]
        return times_of(keys, dict(zip(keys, names, strict=True))).tolist()

    assert times("img100", "img102", "img108", "img110") == [0.0, 1.0, 4.0, 5.0]
    assert times("b1", "a1", "c1") == [1.0, 0.0, 2.0]
    apart = ("7, camera 1 alone", "board")
    assert np.isnan(times_of([("7", "board"), apart], {("7", "board"): "7", apart: "7"})).tolist() == [False, True]
    assert all(a < b for a, b in pairwise(times("9", "10", "11")))
