"""The coach stops only after a whole calibration in the background."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import Executor, Future
from concurrent.futures.process import BrokenProcessPool
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.calibration_scenes import noisy_view
from helpers.coach_scenes import BOARD, CAMERA, SIZE

from rigkit.cameras.base import Camera
from rigkit.cameras.uncertain import UncertainCamera
from rigkit.coach.coach import Coach
from rigkit.coach.full_calibration import STEADY, FullCalibration, FullCalibrations, full_calibration
from rigkit.coach.guide import CHECKING, MIN_GAIN_TO_CONTINUE, CaptureGuide, GuideOptions
from rigkit.coach.keeper import Keeper
from rigkit.coach.look import FrameObservation
from rigkit.core.detections import BoardView
from rigkit.core.reach import Reach
from rigkit.geometry.rigid3 import Rigid3
from rigkit.io.manifests.session import Session
from rigkit.planning.candidates import board_poses_in_view
from rigkit.planning.goal import Goal, projection_goal
from rigkit.workflows.calibration.calibrate import SessionCalibration
from rigkit.workflows.capture.coach import finished_words, open_coach
from rigkit.workflows.options.coach import CoachOptions

FRAMES, NOISE_PX = 10, 0.05
EMPTY = FrameObservation(size_px=SIZE, view=None)


@pytest.fixture(scope="module")
def views() -> list[BoardView]:
    rng, held = np.random.default_rng(8), board_poses_in_view(CAMERA, BOARD, Reach(nearest_mm=250.0))
    return [noisy_view(CAMERA, held.pose(10 * k), f"{k}", rng, NOISE_PX, board=BOARD) for k in range(FRAMES)]


@pytest.fixture(scope="module")
def whole(views: list[BoardView]) -> FullCalibration:
    found = full_calibration(views, SIZE)
    assert found is not None
    return found


class Later(Executor):
    """Does nothing until it is told the result."""

    def __init__(self) -> None:
        self.asked: list[tuple[int, Future[Any]]] = []

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        self.asked.append((len(args[0]), Future()))
        return self.asked[-1][1]

    def tell(self, found: FullCalibration | None) -> int:
        """Answer what was asked last; return of how many frames it was."""
        count, future = self.asked[-1]
        future.set_result(found)
        return count


def guide_of(views: Sequence[BoardView], executor: Executor, goal_px: float) -> CaptureGuide:
    guide = CaptureGuide(GuideOptions(boards=(BOARD,), hfov_deg=52.0, goal_px=goal_px), executor)
    for view in views:
        guide.add(view, SIZE)
    return guide


def test_a_capture_ends_only_after_a_whole_calibration(views: list[BoardView], whole: FullCalibration) -> None:
    later = Later()
    guide = guide_of(views, later, goal_px=10.0)
    seen = FrameObservation(size_px=SIZE, view=views[0], edge_px=2.0, moved_px=0.0, contrast=150.0)
    now = guide.advise(seen)
    assert now.waits and now.words == CHECKING and not now.enough and not now.take
    assert later.tell(whole) == FRAMES and guide.advise(seen).waits, "no held-out error of fewer to compare with"
    assert later.tell(whole) == FRAMES - 1
    now = guide.advise(EMPTY)
    stated = float(projection_goal(whole.stated.camera).error(whole.stated.covariance))
    assert now.enough and not now.waits and now.words.startswith("Enough: ")
    assert [own.error for own in now.remaining] == pytest.approx([stated])
    # Another frame makes it better, but nobody has calibrated it.
    pose = board_poses_in_view(CAMERA, BOARD, Reach(nearest_mm=250.0)).pose(7)
    guide.add(noisy_view(CAMERA, pose, "more", np.random.default_rng(9), NOISE_PX, board=BOARD), SIZE)
    after = guide.advise(EMPTY)
    assert after.waits and not after.enough and after.remaining[0].error < now.remaining[0].error


def test_a_larger_uncertainty_of_the_whole_calibration_asks_for_more(
    views: list[BoardView], whole: FullCalibration
) -> None:
    stated = float(projection_goal(whole.stated.camera).error(whole.stated.covariance))
    # As with a rival that nobody has told apart yet.
    unsure = replace(whole, stated=UncertainCamera(whole.stated.camera, 9.0 * whole.stated.covariance))
    later = Later()
    guide = guide_of(views, later, goal_px=2.0 * stated)
    assert guide.advise(EMPTY).waits
    later.tell(unsure)
    guide.advise(EMPTY)
    later.tell(unsure)
    now = guide.advise(EMPTY)
    assert now.remaining[0].error == pytest.approx(3.0 * stated)
    # What it is less sure of is said, and that more pictures would not bring it where that is so.
    assert not now.enough or f"not {2.0 * stated:g} px" in now.words


def test_a_held_out_error_that_changes_asks_for_one_more(views: list[BoardView], whole: FullCalibration) -> None:
    typical = whole.calibration.heldout_rms_px
    assert typical is not None
    worse = replace(whole.calibration, heldout_rms_px=(1.0 + 2.0 * STEADY) * typical)
    later = Later()
    guide = guide_of(views, later, goal_px=10.0)
    guide.advise(EMPTY)
    later.tell(whole)
    guide.advise(EMPTY)
    later.tell(replace(whole, calibration=worse))
    now = guide.advise(EMPTY)
    assert not now.enough and not now.waits and now.words.startswith("One more as confirmation: ")


def test_without_its_process_the_capture_goes_on(views: list[BoardView], whole: FullCalibration) -> None:
    def calibrated(*_: object) -> FullCalibration:
        return whole

    class Ended(Executor):
        def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
            raise BrokenProcessPool

    later = Later()
    at_once, meanwhile = (FullCalibrations(executor, calibrated) for executor in (Ended(), later))
    at_once.start(views, SIZE)
    meanwhile.start(views, SIZE)
    later.asked[0][1].set_exception(BrokenProcessPool())
    assert not meanwhile.collect()
    meanwhile.start(views, SIZE)
    assert at_once.collect() and meanwhile.collect() and at_once.latest is meanwhile.latest is whole


def test_asking_for_the_state_takes_in_a_finished_calibration(
    views: list[BoardView], whole: FullCalibration, tmp_path: Path
) -> None:
    """Photos come one by one: no look follows the last."""
    later = Later()
    wanted = GuideOptions(boards=(BOARD,), hfov_deg=52.0, goal_px=10.0)
    coach = open_coach(CoachOptions(folder=tmp_path, boards=("9x6x25",), guide=wanted), executor=later)
    for view in views:
        coach.guide.add([FrameObservation(size_px=SIZE, view=view)])
    coach.look([np.full((SIZE[1], SIZE[0], 3), 90, np.uint8)])
    assert coach.state()["waits"]
    for _ in range(2):
        later.tell(whole)
        coach.state()
    assert coach.state()["enough"] and not coach.state()["waits"]


@pytest.mark.parametrize(("px", "mm"), [(2.0, 2.0), (0.5, 2.0), (2.0, 0.5)])
def test_there_are_enough_only_where_the_projection_and_the_length_are_as_wanted(
    views: list[BoardView], whole: FullCalibration, px: float, mm: float
) -> None:
    def measured(cameras: Sequence[Camera], _: Sequence[Rigid3]) -> Sequence[Goal]:
        return [replace(projection_goal(cameras[0]), unit="mm")]

    stated = float(projection_goal(whole.stated.camera).error(whole.stated.covariance))
    later = Later()
    wanted = GuideOptions(boards=(BOARD,), hfov_deg=52.0, goal_px=px * stated, goal_mm=mm * stated, measured=measured)
    guide = CaptureGuide(wanted, later)
    for view in views:
        guide.add(view, SIZE)
    for _ in range(2):
        guide.advise(EMPTY)
        later.tell(whole)
    now = guide.advise(EMPTY)
    assert [own.reached for own in now.remaining] == [px > 1.0, mm > 1.0]
    assert now.more_percent is not None and now.more_percent > 100.0 * MIN_GAIN_TO_CONTINUE, "more pictures would help"
    assert now.enough is (min(px, mm) > 1.0) and not now.waits
    assert wanted.stated(whole.calibration).count("as wanted") == (px > 1.0) + (mm > 1.0)


def test_what_came_of_one_camera_is_said_as_its_calibration_states_it(
    whole: FullCalibration, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    session = Session(
        path=tmp_path / "session.toml", images=(), boards=(BOARD,), model="auto", degree=None, board_shape="auto"
    )
    written = (tmp_path / "calibration.json", tmp_path / "page.html")
    done = SessionCalibration(session=session, calibration=whole.calibration, unreadable={}, written=written)
    monkeypatch.setattr("rigkit.workflows.capture.coach.calibrate_session_file", lambda *_: done)
    reported: list[str] = []
    wanted = GuideOptions(boards=(BOARD,), hfov_deg=52.0, goal_px=100.0)
    coach = Coach(wanted, Keeper(tmp_path, {}), lambda: finished_words(tmp_path, wanted), report=reported.append)
    words = coach.finish(". What it lacks: nothing")
    assert words.startswith(f"Done: {whole.calibration.camera.model}, {wanted.stated(whole.calibration)}, held-out ")
    assert "(as wanted)" in words and "calibration.json written" in words and words.endswith("What it lacks: nothing")
    assert reported == [words] and coach.finished == words
