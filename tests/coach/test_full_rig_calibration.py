"""The coach for rigs stops only after a calibration of the whole rig: lenses, mounts and the user's measurement."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import Executor, Future
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.coach_scenes import BOARD, REACH, SIZE, both, shared_boards

from rigkit.calibration.certainty.displaced import lens_modes, uncertain_camera
from rigkit.calibration.result import Calibration
from rigkit.calibration.rig.calibrate import calibrate_rig
from rigkit.calibration.rig.result import RigCalibration
from rigkit.coach.full_calibration import STEADY, FullCalibration
from rigkit.coach.full_rig_calibration import RigKnowledge, full_rig_calibration, remaining_errors_of_rig
from rigkit.coach.guide import CHECKING, GuideOptions
from rigkit.coach.look import FrameObservation
from rigkit.coach.rig import MAX_HELP, RigGuide
from rigkit.core.errors import DegenerateError
from rigkit.core.measurement_task import Quantity, Task
from rigkit.io.manifests.rig_session import RigSession
from rigkit.planning.goal import projection_goal
from rigkit.planning.information import Knowledge
from rigkit.workflows.calibration.calibrate import RigSessionCalibration
from rigkit.workflows.calibration.next_pictures import length_goals
from rigkit.workflows.capture.coach import finished_words

NAMES, OTHER = ("left", "right"), "right"
FRAMES = 10
EMPTY = [FrameObservation(size_px=SIZE, view=None)] * 2
LENGTH = Task(quantity=Quantity.LENGTH, size_mm=100.0, distance_mm=600.0)


def frame(k: int, rng: np.random.Generator) -> list[FrameObservation]:
    """What both cameras see of a board that both see."""
    in_a, _ = shared_boards(60)
    seen = both(in_a.pose(k), rng, f"{k}")
    return [replace(g, view=replace(g.view, image=f"{n}{k}")) for n, g in zip(NAMES, seen, strict=True) if g.view]


@pytest.fixture(scope="module")
def frames() -> list[list[FrameObservation]]:
    rng = np.random.default_rng(5)
    return [frame(4 * k, rng) for k in range(FRAMES)]


@pytest.fixture(scope="module")
def rig(frames: list[list[FrameObservation]]) -> RigCalibration:
    views = {
        name: [(f"{k}", seen[c].view) for k, seen in enumerate(frames) if seen[c].view is not None]
        for c, name in enumerate(NAMES)
    }
    return calibrate_rig(views, dict.fromkeys(NAMES, SIZE), model="brown", degree=5)  # type: ignore[arg-type]


@dataclass
class Later(Executor):
    """Has the lenses' calibrations at hand, sure of all; the rig's come when that is told."""

    rig: RigCalibration
    asked: list[tuple[int, Future[RigCalibration | None]]] = field(default_factory=list)
    candidate_fits: list[Any] = field(default_factory=list)
    lenses: list[Callable[[], None]] = field(default_factory=list)
    """Calibrations of lenses that are not done: those of so many as are `slow`."""
    slow: int = 0

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        future: Future[Any] = Future()
        if fn is full_rig_calibration:
            self.asked.append((len(args[0]), future))
            self.candidate_fits.append(args[3])
        else:
            own = self.rig.single[NAMES.index(OTHER if args[0][0].image.startswith(OTHER) else NAMES[0])]
            known = f"begun {len(args[0])}"
            knowledge = Knowledge.of(own).with_model_inadequacy(lens_modes(own))
            found = FullCalibration(own, knowledge, uncertain_camera(own), known)  # type: ignore[arg-type]
            self.lenses.append(partial(future.set_result, found))
            if len(self.lenses) > self.slow:
                self.lenses.pop()()
        return future

    def tell(self, found: RigCalibration) -> int:
        count, future = self.asked[-1]
        future.set_result(found)
        return count


def guide_of(frames: Sequence[Sequence[FrameObservation]], executor: Executor, **more: Any) -> RigGuide:
    wanted: dict[str, Any] = {"boards": (BOARD,), "hfov_deg": 52.0, "goal_px": 3.0, "reach": REACH} | more
    guide = RigGuide(NAMES, GuideOptions(**wanted), executor)
    for seen in frames:
        guide.add(seen)
    return guide


def reported(guide: RigGuide, later: Later, found: RigCalibration) -> None:
    """Tell the guide what came of all frames, and of all but the last."""
    assert guide.advise(EMPTY).waits
    assert later.tell(found) == FRAMES and guide.advise(EMPTY).waits, "no held-out error of fewer to compare with"
    assert later.tell(later.rig) == FRAMES - 1


def test_a_capture_ends_only_after_the_rig_is_calibrated(
    frames: list[list[FrameObservation]], rig: RigCalibration
) -> None:
    later = Later(rig)
    guide = guide_of(frames, later)
    now = guide.advise(EMPTY)
    assert all(lens.enough for lens in now.lenses) and now.mount_px is not None and now.mount_px < 3.0
    assert now.waits and now.words == CHECKING and not now.enough and guide.advise(frames[0]).take is False
    reported(guide, later, rig)
    now = guide.advise(EMPTY)
    assert now.enough and now.words.startswith("Enough: left ") and "together" in now.words
    assert [own.requirement.whose for own in now.remaining] == ["left", "right", "together"]
    # The rig's own statements: of each lens as its calibration has it, and of all projections together.
    for own, camera in zip(now.remaining, rig.cameras, strict=False):
        known = uncertain_camera(camera.calibration)
        stated = float(projection_goal(known.camera).error(known.covariance))
        assert own.error == pytest.approx(stated, rel=0.1)
    state = guide.state(EMPTY, now)
    assert state["error"].startswith("left ") and state["share"] <= 1.0 and state["mount_px"] is None


def test_the_rig_reuses_the_calibrations_of_its_lenses(
    frames: list[list[FrameObservation]], rig: RigCalibration
) -> None:
    later = Later(rig, slow=1)
    guide = guide_of(frames, later)
    for _ in range(3):
        assert not guide.advise(EMPTY).enough
    assert len(later.lenses) == 1 and not later.asked, "the first lens is not done"
    later.slow = 0
    later.lenses.pop()()
    guide.advise(EMPTY)
    assert later.candidate_fits == [[f"begun {FRAMES}"] * 2]


def test_what_the_rig_is_less_sure_of_is_asked_for(
    frames: list[list[FrameObservation]], rig: RigCalibration, rng: np.random.Generator
) -> None:
    # The mount is a hundred times less sure than the boards that both see say.
    unsure, mount = rig.covariance.copy(), rig.mount(1)
    unsure[mount] *= 100.0
    unsure[:, mount] *= 100.0
    doubtful = replace(rig, covariance=unsure)
    later = Later(rig)
    guide = guide_of(frames, later)
    reported(guide, later, doubtful)
    now = guide.advise(EMPTY)
    *lenses, together = now.remaining
    assert all(own.reached for own in lenses) and not together.reached
    assert not now.enough and not now.waits and now.words.startswith("Hold the board where ")
    assert all(target is not None for target in now.targets), "outlines in both images"
    seen = guide.advise(frame(3, rng))
    assert seen.frame_gain > 0.2 and guide.advise(frames[-1]).frame_gain == 0.0, "the board was not moved"


def test_a_held_out_error_of_the_rig_that_changes_asks_for_one_more(
    frames: list[list[FrameObservation]], rig: RigCalibration
) -> None:
    typical = rig.heldout_rms_px
    assert typical is not None
    later = Later(rig)
    guide = guide_of(frames, later)
    reported(guide, later, replace(rig, heldout_rms_px=(1.0 + 2.0 * STEADY) * typical))
    now = guide.advise(EMPTY)
    assert not now.enough and now.words.startswith("One more as confirmation: hold the board")


def test_a_length_that_both_measure_is_required(frames: list[list[FrameObservation]], rig: RigCalibration) -> None:
    def measured(cameras: Sequence[Any], cam_from_rig: Sequence[Any]) -> Any:
        return length_goals(cameras, cam_from_rig, LENGTH)

    options = GuideOptions(boards=(BOARD,), goal_px=3.0, goal_mm=1.0, measured=measured, reach=REACH)
    in_mm = remaining_errors_of_rig(rig, options)[-1]
    assert in_mm.requirement.goal.unit == "mm" and in_mm.error > 0.0
    for part, enough in ((2.0, True), (0.5, False)):
        later = Later(rig)
        guide = guide_of(frames, later, goal_mm=part * in_mm.error, measured=measured)
        reported(guide, later, rig)
        now = guide.advise(EMPTY)
        assert all(own.reached for own in now.remaining[:-1]) and now.remaining[-1].reached is enough
        assert now.enough is enough or f"not {0.5 * in_mm.error:g} mm" in now.words


def test_a_length_that_is_nowhere_in_view_is_said(frames: list[list[FrameObservation]], rig: RigCalibration) -> None:
    def nowhere(*_: object) -> Any:
        raise DegenerateError("nowhere is it in view")

    later = Later(rig)
    guide = guide_of(frames, later, goal_mm=1.0, measured=nowhere)
    reported(guide, later, rig)
    now = guide.advise(EMPTY)
    assert not now.enough and now.words == "nowhere is it in view"


def test_what_came_of_a_rig_is_said_as_the_rig_states_it(
    rig: RigCalibration, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    session = RigSession(path=tmp_path / "session.toml", cameras={}, frames=None, baselines=())
    done = RigSessionCalibration(
        session=session, rig=rig, checks=(), unreadable={}, written=(tmp_path / "rig.json", tmp_path / "page.html")
    )
    monkeypatch.setattr("rigkit.workflows.capture.coach.calibrate_session_file", lambda *_: done)
    options = GuideOptions(boards=(BOARD,), goal_px=3.0, reach=REACH)
    words = finished_words(tmp_path, options)
    assert words.count("(as wanted)") == 3 and "together" in words and "rig.json written" in words

    def nowhere(*_: object) -> Any:
        raise DegenerateError("nowhere is it in view")

    assert "nowhere" in finished_words(tmp_path, replace(options, goal_mm=1.0, measured=nowhere))


def test_frames_of_a_rig_are_calibrated_by_their_moments(
    frames: list[list[FrameObservation]], rig: RigCalibration, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(
        "rigkit.coach.full_rig_calibration.calibrate_rig",
        lambda views, sizes, model, board, candidate_fits: calibrate_rig(
            views, sizes, model="brown", degree=5, folds=0
        ),
    )
    views = [[frame_observation.view for frame_observation in seen] for seen in frames]
    found = full_rig_calibration([*views[:-1], [views[-1][0], None]], NAMES, [SIZE, SIZE])
    assert found is not None and found.shared_count == FRAMES - 1
    assert found.baseline_mm(*NAMES)[0] == pytest.approx(rig.baseline_mm(*NAMES)[0], rel=0.02)
    never_both = [[left, None] if k % 2 else [None, right] for k, (left, right) in enumerate(views)]
    assert full_rig_calibration(never_both, NAMES, [SIZE, SIZE]) is None
    known = RigKnowledge.of(found, GuideOptions(boards=(BOARD,), reach=REACH))
    assert known.plan.views[-1].error < known.plan.error


def test_cameras_that_help_each_other_are_enough_before_each_is_alone(
    frames: list[list[FrameObservation]], rig: RigCalibration
) -> None:
    goal_px = max(own.error for own in remaining_errors_of_rig(rig, GuideOptions(boards=(BOARD,), reach=REACH)))
    for factor, enough in ((0.7 * MAX_HELP, True), (1.5 * MAX_HELP, False)):
        # Each alone is less sure than what is wanted.
        single = [
            replace(own, covariance=(factor * goal_px) ** 2 / _alone_px(own) ** 2 * own.covariance)
            for own in rig.single
        ]
        later = Later(replace(rig, single=tuple(single)))
        guide = guide_of(frames, later, goal_px=1.01 * goal_px)
        for _ in range(2):
            assert not guide.advise(EMPTY).enough
            if later.asked:
                later.tell(rig)
        now = guide.advise(EMPTY)
        assert now.enough is enough and bool(later.asked) is enough
        assert not any(lens.enough for lens in now.lenses)


def _alone_px(calibration: Calibration) -> float:
    known = uncertain_camera(calibration)
    return float(projection_goal(known.camera).error(known.covariance))
