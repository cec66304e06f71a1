"""What to take next of one camera, whether a frame is worth taking, and when there are enough."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, field, replace

import numpy as np

from rigkit.calibration.calibrate import calibrate
from rigkit.calibration.certainty.displaced import uncertain_camera
from rigkit.calibration.choosing.begun import BegunCalibration
from rigkit.calibration.result import Calibration
from rigkit.calibration.views.repeats import cluster_numbers
from rigkit.cameras.base import Camera
from rigkit.cameras.board_pose import cam_from_seen_board
from rigkit.cameras.compare import grid_pixels
from rigkit.coach.look import FrameObservation
from rigkit.coach.whole import WholeCalibrations, whole_calibration
from rigkit.core.arrays import Pixels
from rigkit.core.boards import Board
from rigkit.core.detections import BoardView
from rigkit.core.errors import DegenerateError, InputError
from rigkit.core.processes import Here
from rigkit.geometry.rigid3 import Rigid3
from rigkit.planning.candidates import Reach
from rigkit.planning.goal import Goal, RemainingError, Requirement, projection_goal, px_words, turned_design
from rigkit.planning.guess import guessed_camera
from rigkit.planning.information import CornerError, HeldBoards, Knowledge
from rigkit.planning.plan import Plan, Proposal, covariance_of, plan_views
from rigkit.planning.words import placement

FIRST_FRAMES = 4
"""Before so many frames there is no calibration: the coach goes by a guess of the lens."""
ENOUGH_FRAMES = 8
"""With fewer nobody can tell whether the lens model fits."""
CHECKING = "Wait a moment: is it enough?"
MIN_GAIN = 0.6
"""A frame that brings this part of what the outline would bring is taken, wherever the board is."""
MIN_GAIN_OF_PHOTO = 0.2
"""A photo is there already, and another like the outline may never come: five of these bring as much. One that takes
MIN_GAIN_TO_CONTINUE of the error away is taken, too, however much more the outline would."""
MIN_GAIN_TO_CONTINUE = 0.05
"""Where two more frames would bring less than this, there are enough."""
MODELS_TRIED = (("brown", 5), ("kannala_brandt", None))
LIVE_GRID = (24, 16)
TYPICAL_ERROR = CornerError(0.15, 0.05)


@dataclass(frozen=True, slots=True, kw_only=True)
class GuideOptions:
    """What the pictures are for.

    Attributes
    ----------
    boards : those that may be shown.
    hfov_deg : rough field of view across the image, until pictures say better.
    goal_px : rms error of the projection at which there are enough; of a rig also of what one camera tells another.
    goal_mm : error of `measured` at which there are enough, as well; None: only the projection counts.
    measured : says of cameras, and of where they stand in their rig, what is to be measured with them, in mm; raises
        DegenerateError where that is nowhere in view.
    reach : where boards can be held.
    """

    boards: tuple[Board, ...]
    hfov_deg: float = 70.0
    goal_px: float = 0.1
    goal_mm: float | None = None
    measured: Callable[[Sequence[Camera], Sequence[Rigid3]], Sequence[Goal]] | None = None
    reach: Reach = field(default_factory=Reach)

    def requirements(self, camera: Camera) -> tuple[Requirement, ...]:
        """Return what is to become small of a camera alone: the error of its projection, and what is measured."""
        projection = Requirement(projection_goal(camera, self.reach.field_deg), self.goal_px)
        return projection, *self.lengths((camera,), (Rigid3.identity(),))

    def lengths(self, cameras: Sequence[Camera], cam_from_rig: Sequence[Rigid3]) -> tuple[Requirement, ...]:
        """Return what is measured with cameras, as small as it is wanted; raises DegenerateError where that is nowhere
        in view."""
        if self.goal_mm is None or self.measured is None:
            return ()
        return tuple(Requirement(goal, self.goal_mm) for goal in self.measured(cameras, cam_from_rig))

    def stated(self, calibration: Calibration) -> str:
        """Return in words what a calibration says of the goals: errors, and whether they are small enough."""
        known = uncertain_camera(calibration)
        return stated_words(
            [requirement.remaining(known.covariance) for requirement in self.requirements(known.camera)]
        )


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class Advice:
    """What the coach says.

    Attributes
    ----------
    words : what to do now.
    target_px : (K, 2) outline to hold the board into.
    worth : what this very frame brings, as a part of what a board in the outline would.
    take : this very frame is worth taking.
    enough : there are enough frames.
    waits : nothing is asked for, until it is known whether there are.
    left : what the frames so far leave of what is to become small, the projection first; empty where nobody knows yet.
    more_percent : what two more frames would bring.
    """

    words: str
    target_px: Pixels
    worth: float
    take: bool
    enough: bool
    waits: bool
    left: tuple[RemainingError, ...]
    more_percent: float | None

    @property
    def share(self) -> float:
        """What is left as a part of what is wanted, the worst of it; infinite where nobody knows yet."""
        return max((own.share for own in self.left), default=np.inf)


class CaptureGuide:
    """Frames taken so far and what follows from them. All of `calibrate` is done by an executor, which may take its
    time: until then a quick calibration will do, but there are not enough."""

    def __init__(self, options: GuideOptions, executor: Executor | None = None) -> None:
        self.options = options
        self.views: list[BoardView] = []
        self.size_px: tuple[int, int] | None = None
        self._quick: Calibration | None = None
        self._stale = False
        self._whole = WholeCalibrations(executor or Here(), whole_calibration)
        self._plan: Plan | None = None
        self._left_now: tuple[RemainingError, ...] = ()
        self._map: list[list[float | None]] | None = None

    def add(self, view: BoardView, size_px: tuple[int, int]) -> None:
        """Take a frame."""
        self.size_px = size_px
        self.views.append(view)
        self._stale, self._plan, self._map = True, None, None

    @property
    def calibration(self) -> Calibration | None:
        """What the frames so far say, once they say anything."""
        if self._whole.latest is not None:
            return self._whole.latest.calibration
        # Many frames may come at once, when a session goes on: only then is there something to be asked of it.
        if self._stale and self.size_px is not None and len(self.views) >= FIRST_FRAMES:
            self._quick = _calibrated(self.views, self.size_px) or self._quick
        self._stale = False
        return self._quick

    @property
    def has_many(self) -> bool:
        """Whether there are frames enough to tell whether the lens model fits."""
        return _distinct(self.views) >= ENOUGH_FRAMES

    @property
    def is_calibrated(self) -> bool:
        """Whether all of `calibrate` has been asked of all frames, and answered."""
        return not self._whole.is_new(self.views)

    @property
    def begun(self) -> BegunCalibration | None:
        """What the latest of these calibrations found, for a rig's."""
        return None if self._whole.latest is None else self._whole.latest.begun

    def _go_on(self) -> None:
        """Take what has been calibrated meanwhile, and have calibrated what has come."""
        if self.size_px is None or not self.has_many:
            return
        if self._whole.go_on(self.views, self.size_px):
            self._plan = self._map = None

    def advise(self, frame_observation: FrameObservation, *, photo: bool = False) -> Advice:
        """Return what to do, and whether to take this frame, or `photo`."""
        self._go_on()
        plan = self._planned(frame_observation.size_px)
        target = self.asked(frame_observation.size_px)
        where = placement(plan.knowledge.camera, target.board, target.cam_from_board)
        worth, min_gain = self._gain(frame_observation.view, plan, photo=photo), min_gain_of(photo=photo)
        left = () if self.calibration is None else self._left_now
        would_do = bool(left) and self.has_many
        would_do = would_do and (all(own.reached for own in left) or plan.gain < MIN_GAIN_TO_CONTINUE)
        steady = self._whole.steady(len(self.views)) if would_do else False
        words = f"Hold the board: {where}"
        if steady is None:
            words = CHECKING
        elif steady:
            words = enough_words(left, plan.gain, plan.knowledge.camera)
        elif frame_observation.view is not None and worth >= min_gain and frame_observation.complaint:
            words = frame_observation.complaint.capitalize()
        elif would_do:
            words = f"One more, to see that it is steady: {where}"
        return Advice(
            words=words,
            target_px=where.outline_px,
            worth=worth,
            take=not frame_observation.complaint and worth >= min_gain and steady is False,
            enough=steady is True,
            waits=steady is None,
            left=left,
            more_percent=100.0 * plan.gain if left else None,
        )

    def asked(self, size_px: tuple[int, int]) -> Proposal:
        """Return where the outline is."""
        return self._planned(size_px).views[0]

    def camera(self, size_px: tuple[int, int]) -> Camera:
        """Return the camera as far as it is known."""
        return self._planned(size_px).knowledge.camera

    def corner_error(self, size_px: tuple[int, int]) -> CornerError:
        """Return how wrong its corners are."""
        return self._planned(size_px).knowledge.error

    def pose_of(self, view: BoardView, size_px: tuple[int, int]) -> Rigid3 | None:
        """Return where a board is; None where the lens does not see enough of it."""
        return _pose(self.camera(size_px), view)

    def _left(self, knowledge: Knowledge) -> tuple[RemainingError, ...]:
        """Return what the frames leave of what is to become small: as all of `calibrate` states it for those that it
        has had."""
        left = [
            requirement.remaining(covariance_of(knowledge.information))
            for requirement in self.options.requirements(knowledge.camera)
        ]
        whole = self._whole.latest
        if whole is None:
            return tuple(left)
        then, stated = covariance_of(whole.knowledge.information), whole.stated.covariance
        factors = [float(own.requirement.goal.error(stated) / own.requirement.goal.error(then)) for own in left]
        return tuple(replace(own, error=own.error * factor) for own, factor in zip(left, factors, strict=True))

    def sigma_map(self) -> list[list[float | None]] | None:
        """Return the rms error of the projection over the image, rows of LIVE_GRID px, None where the lens does not
        see; None before there is a calibration."""
        if self.calibration is None or self.size_px is None:
            return None
        if self._map is None:
            plan = self._planned(self.size_px)
            camera = plan.knowledge.camera
            pixels = grid_pixels(camera.size_px, LIVE_GRID).reshape(-1, 2)
            rays, valid = camera.unproject(pixels)
            turned = turned_design(camera, rays[valid])
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
            self._left_now = self._left(knowledge)
            goal = max(self._left_now, key=lambda own: own.share).requirement.goal
            last = _pose(knowledge.camera, self.views[-1]) if self.views else None
            self._plan = plan_views(knowledge, o.boards, goal, 2, reach=o.reach, last=last)
        return self._plan

    def _known(self, size_px: tuple[int, int]) -> Knowledge:
        later: Sequence[BoardView] = ()
        if self._whole.latest is not None:
            knowledge, later = self._whole.latest.knowledge, self.views[self._whole.count :]
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
                knowledge = knowledge.with_views(held_view(view, pose), view.board.board_id)
        return knowledge

    def repeats(self, view: BoardView) -> bool:
        """Say whether the board was not moved since a frame that is taken: the two count as one."""
        return _distinct([*self.views, view]) == _distinct(self.views)

    def _gain(self, view: BoardView | None, plan: Plan, *, photo: bool) -> float:
        """Return what this frame brings, as a part of what the outline would: nothing where the board was not moved
        since one that is taken, for the two count as one. A photo that is new is worth taking as one of the first, and
        where it takes enough off the error."""
        if view is None or self.repeats(view):
            return 0.0
        pose = _pose(plan.knowledge.camera, view)
        if pose is None:
            return 0.0
        known = plan.knowledge
        more = known.of_views(held_view(view, pose), view.board.board_id)[0]
        worth = relative_gain(plan, float(plan.goal.error(covariance_of(known.information + more))), photo=photo)
        # So few frames do not tell what others would bring.
        return max(worth, MIN_GAIN_OF_PHOTO) if photo and not self.has_many else worth


def relative_gain(plan: Plan, after: float, *, photo: bool) -> float:
    """Return what a frame that leaves the error `after` brings, as a part of what the first of the plan would; of a
    photo also what it takes off the error counts."""
    brings = (plan.error - after) / max(plan.error - plan.views[0].error, 1e-12)
    return max(brings, MIN_GAIN_OF_PHOTO / MIN_GAIN_TO_CONTINUE * (1.0 - after / plan.error)) if photo else brings


def stated_words(left: Sequence[RemainingError]) -> str:
    """Return errors in words, and whether they are small enough."""
    each = (f"{own} ({'as wanted' if own.reached else f'wanted {own.requirement.wanted:g}'})" for own in left)
    return f"error {', '.join(each)}"


def enough_words(left: Sequence[RemainingError], gain: float, camera: Camera | None = None) -> str:
    """Return that there are enough frames, in words; of one `camera` also what an error comes to."""
    message = ", ".join(map(str, left)) if camera is None or len(left) > 1 else px_words(camera, left[0].error)
    missed = [f"{own.requirement.wanted:g} {own.requirement.goal.unit}" for own in left if not own.reached]
    if not missed:
        return f"Enough: {message}; two more pictures would bring {100.0 * gain:.0f} %"
    return f"Enough: {message}, not {' and '.join(missed)}, but two more pictures would bring only {100.0 * gain:.0f} %"


def min_gain_of(*, photo: bool) -> float:
    """Return what a frame has to be worth to be taken."""
    return MIN_GAIN_OF_PHOTO if photo else MIN_GAIN


def _distinct(views: Sequence[BoardView]) -> int:
    """Return how many views there are without those that repeat another."""
    if not views:
        return 0
    names = [f"{k}" for k in range(len(views))]
    return len(set(cluster_numbers(names, [v.board.board_id for v in views], [v.pixels for v in views]).tolist()))


def _pose(camera: Camera, view: BoardView) -> Rigid3 | None:
    try:
        return cam_from_seen_board(camera, view.pixels, view.points())
    except (InputError, DegenerateError):
        return None


def held_view(view: BoardView, pose: Rigid3) -> HeldBoards:
    """Return the corners of a view as a board that is held."""
    seen = np.zeros((1, view.board.corner_count), dtype=bool)
    seen[0, view.board.index(view.grid)] = True
    return HeldBoards(view.board.points(), pose.rotation[None], pose.translation_mm[None], seen)


def _calibrated(views: Sequence[BoardView], size_px: tuple[int, int]) -> Calibration | None:
    """Return the better of the usual narrow and wide models, quickly; None where the views do not determine it. Boards
    bow a little: taken for flat, they make the lens seem to be what it is not, once there are views enough to tell."""
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
