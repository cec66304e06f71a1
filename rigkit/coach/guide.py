"""What to take next, whether a frame is worth taking, and when there are enough: the coach without its page."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from rigkit.calibration.calibrate import calibrate
from rigkit.calibration.result import Calibration
from rigkit.cameras.base import Camera
from rigkit.coach.look import Glance
from rigkit.core.arrays import Pixels
from rigkit.core.boards import Board
from rigkit.core.detections import BoardView
from rigkit.core.errors import RigkitError
from rigkit.geometry.board_pose import board_pose
from rigkit.geometry.rigid3 import Rigid3
from rigkit.planning.candidates import Reach
from rigkit.planning.goal import Goal, projection_goal
from rigkit.planning.guess import guessed_camera
from rigkit.planning.information import CornerError, HeldBoards, Knowledge, view_information
from rigkit.planning.plan import Plan, covariance_of, plan_views
from rigkit.planning.words import placement

__all__ = ["Advice", "CaptureGuide", "GuideOptions"]

FIRST_FRAMES = 4
"""Before so many frames there is no calibration: the coach goes by a guess of the lens."""
ENOUGH_FRAMES = 8
"""With fewer nobody can tell whether the lens model fits."""
WORTH_TAKING = 0.6
"""A frame that brings this part of what the outline would bring is taken, wherever the board is."""
WORTH_GOING_ON = 0.05
"""Where two more frames would bring less than this, there are enough."""
MODELS_TRIED = (("brown", 5), ("kannala_brandt", None))
USUAL_ERROR = CornerError(0.15, 0.05)


@dataclass(frozen=True, slots=True, kw_only=True)
class GuideOptions:
    """What the pictures are for.

    Attributes
    ----------
    boards : those that may be shown.
    hfov_deg : rough field of view across the image, until pictures say better.
    goal_px : rms error of the projection at which there are enough.
    reach : where boards can be held.
    """

    boards: tuple[Board, ...]
    hfov_deg: float = 70.0
    goal_px: float = 0.1
    reach: Reach = field(default_factory=Reach)


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class Advice:
    """What the coach says.

    Attributes
    ----------
    words : what to do now.
    target_px : (K, 2) outline to hold the board into.
    take : this very frame is worth taking.
    enough : there are enough frames.
    error_px : rms error of the projection that the frames so far leave; None where nobody knows yet.
    more_percent : what two more frames would bring.
    """

    words: str
    target_px: Pixels
    take: bool
    enough: bool
    error_px: float | None
    more_percent: float | None


class CaptureGuide:
    """Frames taken so far and what follows from them."""

    def __init__(self, options: GuideOptions) -> None:
        self.options = options
        self.views: list[BoardView] = []
        self.size_px: tuple[int, int] | None = None
        self.calibration: Calibration | None = None
        self._plan: Plan | None = None
        self._held: list[HeldBoards] = []
        self._last: Rigid3 | None = None

    def add(self, view: BoardView, size_px: tuple[int, int]) -> None:
        """Take a frame: calibrate anew, and plan the next."""
        self.size_px = size_px
        self.views.append(view)
        if len(self.views) >= FIRST_FRAMES:
            self.calibration = _calibrated(self.views, size_px) or self.calibration
        pose = self._pose_of(view)
        if pose is not None:
            self._last = pose
            self._held.append(_held(view, pose))
        self._plan = None

    def advise(self, glance: Glance) -> Advice:
        """Return what to do, and whether to take this frame."""
        plan = self._planned(glance.size_px)
        target = plan.views[0]
        where = placement(plan.knowledge.camera, target.board, target.cam_from_board)
        worth = self._worth(glance.view, plan)
        take = glance.view is not None and glance.still and glance.sharp and glance.exposed and worth >= WORTH_TAKING
        error = plan.error if self.calibration is not None else None
        enough = (
            error is not None
            and len(self.views) >= ENOUGH_FRAMES
            and (error <= self.options.goal_px or plan.gain < WORTH_GOING_ON)
        )
        words = f"Hold the board: {where}"
        if glance.view is None or worth >= WORTH_TAKING:
            words = glance.complaint.capitalize() if glance.complaint and glance.view is not None else words
        if enough:
            words = f"Enough: {error:.2g} px; two more pictures would bring {100.0 * plan.gain:.0f} %"
        return Advice(
            words=words,
            target_px=where.outline_px,
            take=bool(take and not enough),
            enough=bool(enough),
            error_px=error,
            more_percent=None if error is None else 100.0 * plan.gain,
        )

    def _planned(self, size_px: tuple[int, int]) -> Plan:
        if self._plan is None:
            knowledge, goal = self._known(size_px)
            o = self.options
            self._plan = plan_views(knowledge, o.boards, goal, 2, reach=o.reach, last=self._last)
        return self._plan

    def _known(self, size_px: tuple[int, int]) -> tuple[Knowledge, Goal]:
        if self.calibration is not None:
            knowledge = Knowledge.of(self.calibration)
        else:
            knowledge = Knowledge.guessed(guessed_camera(self.options.hfov_deg, size_px), USUAL_ERROR)
            for held in self._held:
                knowledge = knowledge.with_views(held)
        return knowledge, projection_goal(knowledge.camera, self.options.reach.field_deg)

    def _worth(self, view: BoardView | None, plan: Plan) -> float:
        """Return what this frame brings, as a part of what the outline would."""
        if view is None:
            return 0.0
        pose = self._pose_of(view, plan.knowledge.camera)
        if pose is None:
            return 0.0
        known = plan.knowledge
        more = view_information(known.camera, _held(view, pose), known.error)[0]
        after = float(plan.goal.error(covariance_of(known.information + more)))
        return (plan.error - after) / max(plan.error - plan.views[0].error, 1e-12)

    def _pose_of(self, view: BoardView, camera: Camera | None = None) -> Rigid3 | None:
        if camera is None:
            assert self.size_px is not None
            camera = self._known(self.size_px)[0].camera
        rays, valid = camera.unproject(view.pixels)
        try:
            return board_pose(rays[valid], view.points()[valid]).cam_from_board
        except RigkitError:
            return None

    def state(self, glance: Glance | None, advice: Advice | None) -> dict[str, Any]:
        """Return what the page shows."""
        out: dict[str, Any] = {"frames": len(self.views), "size_px": self.size_px}
        step = max(1, sum(len(v.pixels) for v in self.views) // 1500)
        seen = np.concatenate([v.pixels for v in self.views])[::step] if self.views else np.zeros((0, 2))
        out["covered"] = np.round(seen, 1).tolist()
        if advice is not None:
            target = advice.target_px
            out |= {
                "words": advice.words,
                "target": np.round(target[np.isfinite(target).all(axis=1)], 1).tolist(),
                "take": advice.take,
                "enough": advice.enough,
                "error_px": advice.error_px,
                "more_percent": advice.more_percent,
                "goal_px": self.options.goal_px,
            }
        if glance is not None:
            corners = [] if glance.view is None else np.round(glance.view.pixels, 1).tolist()
            out |= {
                "size_px": glance.size_px,
                "corners": corners,
                "edge_px": round(glance.edge_px, 2),
                "moved_px": None if glance.moved_px is None else round(glance.moved_px, 2),
                "contrast": round(glance.contrast, 1),
                "sharp": glance.sharp,
                "still": glance.still,
                "exposed": glance.exposed,
            }
        return out


def _held(view: BoardView, pose: Rigid3) -> HeldBoards:
    seen = np.zeros((1, view.board.corner_count), dtype=bool)
    seen[0, view.board.index(view.grid)] = True
    return HeldBoards(view.board.points(), pose.rotation[None], pose.translation_mm[None], seen)


def _calibrated(views: Sequence[BoardView], size_px: tuple[int, int]) -> Calibration | None:
    """Return the better of the usual narrow and wide models, quickly; None where the views do not determine it."""
    best: Calibration | None = None
    named = [replace(view, image=f"{k:04d}") for k, view in enumerate(views)]
    for model, degree in MODELS_TRIED:
        try:
            found = calibrate(named, size_px, model=model, degree=degree, board="flat", folds=0)
        except RigkitError:
            continue
        if best is None or found.rms_px < best.rms_px:
            best = found
    return best
