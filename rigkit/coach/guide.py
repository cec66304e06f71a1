"""Guidance for one camera: what to take next, whether to take a frame, and when there are enough."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, field, replace

import numpy as np

from rigkit.calibration.calibrate import calibrate
from rigkit.calibration.certainty.displaced import uncertain_camera
from rigkit.calibration.choosing.candidate_fits import CandidateFits
from rigkit.calibration.result import Calibration
from rigkit.calibration.views.repeats import cluster_numbers
from rigkit.cameras.base import Camera
from rigkit.cameras.board_pose import cam_from_seen_board
from rigkit.cameras.compare import grid_pixels
from rigkit.coach.full_calibration import FullCalibrations, full_calibration
from rigkit.coach.look import FrameObservation
from rigkit.core.arrays import Pixels
from rigkit.core.boards import Board
from rigkit.core.detections import BoardView
from rigkit.core.errors import DegenerateError, InputError
from rigkit.core.processes import SerialExecutor
from rigkit.core.reach import Reach
from rigkit.geometry.rigid3 import Rigid3
from rigkit.planning.candidates import placement
from rigkit.planning.goal import Goal, RemainingError, Requirement, projection_goal, px_words, rotation_free_jacobian
from rigkit.planning.information import BoardPoses, CornerError, Knowledge, guessed_camera
from rigkit.planning.plan import Plan, Proposal, covariance_of, plan_views

FIRST_FRAMES = 4
"""Frames needed for a first calibration; before it, plans use a guessed lens."""
ENOUGH_FRAMES = 8
"""With fewer frames it cannot be tested whether the lens model fits."""
CHECKING = "Wait: checking whether it is enough"
MIN_GAIN = 0.6
"""Least gain for which a frame is taken, relative to that of a board in the outline."""
MIN_GAIN_OF_PHOTO = 0.2
"""The same for a photo: it exists already, and one with the board in the outline may never come; five of these have its
gain. A photo that lowers the error by MIN_GAIN_TO_CONTINUE is taken too, however much more the outline would."""
MIN_GAIN_TO_CONTINUE = 0.05
"""Where two more frames would lower the error by less than this part, there are enough."""
MODELS_TRIED = (("brown", 5), ("kannala_brandt", None))
LIVE_GRID = (24, 16)
TYPICAL_ERROR = CornerError(0.15, 0.05)


@dataclass(frozen=True, slots=True, kw_only=True)
class GuideOptions:
    """The purpose of the images.

    Attributes
    ----------
    boards : those that may be shown.
    hfov_deg : approximate horizontal field of view, used until the first calibration.
    goal_px : projection uncertainty to reach, rms; for a rig also with the mounts included.
    goal_mm : standard deviation to reach for the measured length as well.
    measured : returns the goals, in mm, of what will be measured with cameras at their poses in the rig; raises
        DegenerateError where that is outside all fields of view.
    reach : where boards can be held.
    """

    boards: tuple[Board, ...]
    hfov_deg: float = 70.0
    goal_px: float = 0.1
    goal_mm: float | None = None
    measured: Callable[[Sequence[Camera], Sequence[Rigid3]], Sequence[Goal]] | None = None
    reach: Reach = field(default_factory=Reach)

    def requirements(self, camera: Camera) -> tuple[Requirement, ...]:
        """Return the requirements on a single camera: on the error of its projection, and on what is measured."""
        projection = Requirement(projection_goal(camera, self.reach.field_deg), self.goal_px)
        return projection, *self.lengths((camera,), (Rigid3.identity(),))

    def lengths(self, cameras: Sequence[Camera], cam_from_rig: Sequence[Rigid3]) -> tuple[Requirement, ...]:
        """Return the requirements on what is measured with cameras; raises DegenerateError where that is outside all
        fields of view."""
        if self.goal_mm is None or self.measured is None:
            return ()
        return tuple(Requirement(goal, self.goal_mm) for goal in self.measured(cameras, cam_from_rig))

    def stated(self, calibration: Calibration) -> str:
        """Return in words the errors of a calibration, and whether they meet the requirements."""
        known = uncertain_camera(calibration)
        return errors_in_words(
            [requirement.remaining(known.covariance) for requirement in self.requirements(known.camera)]
        )


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class Advice:
    """The coach's advice on a frame.

    Attributes
    ----------
    words : what to do now.
    target_px : (K, 2) outline to hold the board into.
    frame_gain : gain of this frame, relative to that of a board in the outline.
    take : whether to take this frame.
    enough : there are enough frames.
    waits : no instruction, until a calibration shows whether there are enough.
    remaining : errors after the frames so far with their requirements, the projection first; empty before a
        calibration.
    more_percent : reduction of the error by two more frames.
    """

    words: str
    target_px: Pixels
    frame_gain: float
    take: bool
    enough: bool
    waits: bool
    remaining: tuple[RemainingError, ...]
    more_percent: float | None

    @property
    def share(self) -> float:
        """The largest error relative to its requirement; infinite before a calibration."""
        return max((own.share for own in self.remaining), default=np.inf)


class CaptureGuide:
    """The frames taken so far and the advice that follows from them. An executor runs the full `calibrate`: until it
    has finished, a quick calibration is used, but there are never enough frames."""

    def __init__(self, options: GuideOptions, executor: Executor | None = None) -> None:
        self.options = options
        self.views: list[BoardView] = []
        self.size_px: tuple[int, int] | None = None
        self._quick: Calibration | None = None
        self._stale = False
        self._full = FullCalibrations(executor or SerialExecutor(), full_calibration)
        self._plan: Plan | None = None
        self._remaining: tuple[RemainingError, ...] = ()
        self._map: list[list[float | None]] | None = None

    def add(self, view: BoardView, size_px: tuple[int, int]) -> None:
        """Add a frame."""
        self.size_px = size_px
        self.views.append(view)
        self._stale, self._plan, self._map = True, None, None

    @property
    def calibration(self) -> Calibration | None:
        """The calibration from the frames so far; None before there is one."""
        if self._full.latest is not None:
            return self._full.latest.calibration
        # A resumed session adds many frames at once: it is calibrated only on demand.
        if self._stale and self.size_px is not None and len(self.views) >= FIRST_FRAMES:
            self._quick = _calibrated(self.views, self.size_px) or self._quick
        self._stale = False
        return self._quick

    @property
    def has_many(self) -> bool:
        """Whether there are enough frames to test whether the lens model fits."""
        return _distinct(self.views) >= ENOUGH_FRAMES

    @property
    def is_calibrated(self) -> bool:
        """Whether the full `calibrate` has finished for all frames."""
        return not self._full.is_unfinished(self.views)

    @property
    def candidate_fits(self) -> CandidateFits | None:
        """The intermediate results of the latest full calibration, for that of a rig."""
        return None if self._full.latest is None else self._full.latest.candidate_fits

    def _update_calibration(self) -> None:
        """Use finished calibrations, and start one of new frames."""
        if self.size_px is None or not self.has_many:
            return
        if self._full.update(self.views, self.size_px):
            self._plan = self._map = None

    def advise(self, observation: FrameObservation, *, photo: bool = False) -> Advice:
        """Return what to do, and whether to take this frame, or `photo`."""
        self._update_calibration()
        plan = self._planned(observation.size_px)
        target = self.requested_view(observation.size_px)
        where = placement(plan.knowledge.camera, target.board, target.cam_from_board)
        frame_gain, min_gain = self._frame_gain(observation.view, plan, photo=photo), min_gain_of(photo=photo)
        remaining = () if self.calibration is None else self._remaining
        reached = all(own.reached for own in remaining) or plan.gain < MIN_GAIN_TO_CONTINUE
        would_do = bool(remaining) and self.has_many and reached
        steady = self._full.is_steady(len(self.views)) if would_do else False
        enough, waits = steady is True, steady is None
        is_worth_taking = frame_gain >= min_gain
        if waits:
            words = CHECKING
        elif enough:
            words = enough_words(remaining, plan.gain, plan.knowledge.camera)
        elif is_worth_taking and observation.complaint:
            words = observation.complaint.capitalize()
        else:
            words = f"{'One more as confirmation' if would_do else 'Hold the board'}: {where}"
        return Advice(
            words=words,
            target_px=where.outline_px,
            frame_gain=frame_gain,
            take=is_worth_taking and not (observation.complaint or enough or waits),
            enough=enough,
            waits=waits,
            remaining=remaining,
            more_percent=100.0 * plan.gain if remaining else None,
        )

    def requested_view(self, size_px: tuple[int, int]) -> Proposal:
        """Return the view that is asked for."""
        return self._planned(size_px).views[0]

    def camera(self, size_px: tuple[int, int]) -> Camera:
        """Return the present estimate of the camera."""
        return self._planned(size_px).knowledge.camera

    def corner_error(self, size_px: tuple[int, int]) -> CornerError:
        """Return the error of its corners."""
        return self._planned(size_px).knowledge.error

    def pose_of(self, view: BoardView, size_px: tuple[int, int]) -> Rigid3 | None:
        """Return the pose of a board; None where the field of view has too little of it."""
        return _pose(self.camera(size_px), view)

    def _remaining_errors(self, knowledge: Knowledge) -> tuple[RemainingError, ...]:
        """Return the errors after the frames so far with their requirements, scaled to those that the latest full
        calibration states for its frames."""
        remaining = [
            requirement.remaining(covariance_of(knowledge.information))
            for requirement in self.options.requirements(knowledge.camera)
        ]
        whole = self._full.latest
        if whole is None:
            return tuple(remaining)
        then, stated = covariance_of(whole.knowledge.information), whole.stated.covariance
        factors = [float(own.requirement.goal.error(stated) / own.requirement.goal.error(then)) for own in remaining]
        return tuple(replace(own, error=own.error * factor) for own, factor in zip(remaining, factors, strict=True))

    def sigma_map(self) -> list[list[float | None]] | None:
        """Return the rms error of the projection over the image, as rows of LIVE_GRID px, None outside the field of
        view; None before there is a calibration."""
        if self.calibration is None or self.size_px is None:
            return None
        if self._map is None:
            plan = self._planned(self.size_px)
            camera = plan.knowledge.camera
            pixels = grid_pixels(camera.size_px, LIVE_GRID).reshape(-1, 2)
            rays, valid = camera.unproject(pixels)
            turned = rotation_free_jacobian(camera, rays[valid])
            p = camera.parameters.size
            covariance = covariance_of(plan.knowledge.information)[:p, :p]
            sigma = np.full(len(pixels), np.nan)
            sigma[valid] = np.sqrt(np.einsum("nip,pq,niq->n", turned, covariance, turned))
            rows = sigma.reshape(LIVE_GRID[1], LIVE_GRID[0])
            self._map = [[None if np.isnan(s) else round(float(s), 4) for s in row] for row in rows]
        return self._map

    def _planned(self, size_px: tuple[int, int]) -> Plan:
        if self._plan is None:
            knowledge, o = self._known(size_px), self.options
            self._remaining = self._remaining_errors(knowledge)
            goal = max(self._remaining, key=lambda own: own.share).requirement.goal
            last = _pose(knowledge.camera, self.views[-1]) if self.views else None
            self._plan = plan_views(knowledge, o.boards, goal, 2, reach=o.reach, last=last)
        return self._plan

    def _known(self, size_px: tuple[int, int]) -> Knowledge:
        later: Sequence[BoardView] = ()
        if self._full.latest is not None:
            knowledge, later = self._full.latest.knowledge, self.views[self._full.count :]
        elif self.calibration is not None:
            knowledge = Knowledge.of(self.calibration)
        else:
            knowledge, later = (
                Knowledge.guessed(guessed_camera(self.options.hfov_deg, size_px), TYPICAL_ERROR),
                self.views,
            )
        for view in later:
            pose = _pose(knowledge.camera, view)
            if pose is not None:
                knowledge = knowledge.with_views(posed_view(view, pose), view.board.board_id)
        return knowledge

    def repeats(self, view: BoardView) -> bool:
        """Say whether the board has not moved since a frame already taken: the two count as one."""
        return _distinct([*self.views, view]) == _distinct(self.views)

    def _frame_gain(self, view: BoardView | None, plan: Plan, *, photo: bool) -> float:
        """Return the gain of this frame, relative to that of a board in the outline: 0 where the board has not moved
        since a frame already taken. A new photo is always good enough among the first frames, and later where it lowers
        the error enough."""
        if view is None or self.repeats(view):
            return 0.0
        pose = _pose(plan.knowledge.camera, view)
        if pose is None:
            return 0.0
        known = plan.knowledge
        more = known.of_views(posed_view(view, pose), view.board.board_id)[0]
        frame_gain = relative_gain(plan, float(plan.goal.error(covariance_of(known.information + more))), photo=photo)
        # With so few frames the gain of others cannot be predicted.
        return max(frame_gain, MIN_GAIN_OF_PHOTO) if photo and not self.has_many else frame_gain


def relative_gain(plan: Plan, after: float, *, photo: bool) -> float:
    """Return the gain of a frame that leaves the error `after`, relative to that of the first view of the plan; for a
    photo, its reduction of the error counts as well."""
    brings = (plan.error - after) / max(plan.error - plan.views[0].error, 1e-12)
    return max(brings, MIN_GAIN_OF_PHOTO / MIN_GAIN_TO_CONTINUE * (1.0 - after / plan.error)) if photo else brings


def errors_in_words(remaining: Sequence[RemainingError]) -> str:
    """Return errors in words, and whether they meet their requirements."""
    each = (f"{own} ({'as wanted' if own.reached else f'wanted {own.requirement.wanted:g}'})" for own in remaining)
    return f"error {', '.join(each)}"


def enough_words(remaining: Sequence[RemainingError], gain: float, camera: Camera | None = None) -> str:
    """Return in words that there are enough frames; for one `camera` also the effect of the error at 1 m."""
    message = (
        ", ".join(map(str, remaining)) if camera is None or len(remaining) > 1 else px_words(camera, remaining[0].error)
    )
    missed = [f"{own.requirement.wanted:g} {own.requirement.goal.unit}" for own in remaining if not own.reached]
    if not missed:
        return f"Enough: {message}; two more pictures would bring {100.0 * gain:.0f} %"
    return f"Enough: {message}, not {' and '.join(missed)}, but two more pictures would bring only {100.0 * gain:.0f} %"


def min_gain_of(*, photo: bool) -> float:
    """Return the least relative gain for which a frame is taken."""
    return MIN_GAIN_OF_PHOTO if photo else MIN_GAIN


def _distinct(views: Sequence[BoardView]) -> int:
    """Return the number of views without repeats."""
    if not views:
        return 0
    names = [f"{k}" for k in range(len(views))]
    return len(set(cluster_numbers(names, [v.board.board_id for v in views], [v.pixels for v in views]).tolist()))


def _pose(camera: Camera, view: BoardView) -> Rigid3 | None:
    try:
        return cam_from_seen_board(camera, view.pixels, view.points())
    except (InputError, DegenerateError):
        return None


def posed_view(view: BoardView, pose: Rigid3) -> BoardPoses:
    """Return a view as a board with its corners seen in one pose."""
    seen = np.zeros((1, view.board.corner_count), dtype=bool)
    seen[0, view.board.index(view.grid)] = True
    return BoardPoses(view.board.points(), pose.rotation[None], pose.translation_mm[None], seen)


def _calibrated(views: Sequence[BoardView], size_px: tuple[int, int]) -> Calibration | None:
    """Return the better of a narrow and a wide model, fitted quickly; None where the views do not determine it. With
    enough views boards may be warped: assuming them flat would bias the lens."""
    named = [replace(view, image=f"{k:04d}") for k, view in enumerate(views)]
    for board in ("warp", "flat") if len(views) >= ENOUGH_FRAMES else ("flat",):
        best: Calibration | None = None
        for model, degree in MODELS_TRIED:
            try:
                found = calibrate(named, size_px, model=model, degree=degree, board=board, folds=0, pupil="central")
            except (InputError, DegenerateError):
                continue
            if best is None or found.rms_px < best.rms_px:
                best = found
        if best is not None:
            return best
    return None
