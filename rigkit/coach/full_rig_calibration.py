"""Full calibration of a rig from all its frames: whether there are enough, and what to take next where not.

Lenses and mounts that are each good enough may not be so together, and a rig may determine its lenses better than they
do alone. Only the rig's calibration predicts the result of the session.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Self

import numpy as np

from rigkit.calibration.choosing.candidate_fits import CandidateFits
from rigkit.calibration.rig.calibrate import calibrate_rig
from rigkit.calibration.rig.result import RigCalibration
from rigkit.calibration.rig.solving.layout import Layout
from rigkit.cameras.board_pose import cam_from_seen_board
from rigkit.coach.guide import GuideOptions, relative_gain
from rigkit.core.arrays import Pixels
from rigkit.core.detections import BoardView
from rigkit.core.errors import DegenerateError, InputError
from rigkit.planning.candidates import placement
from rigkit.planning.goal import RemainingError, Requirement, projection_goal, rig_goal
from rigkit.planning.plan import Plan, covariance_of
from rigkit.validation.monitoring.evidence import Monitored, board_information
from rigkit.validation.monitoring.frames import Frames
from rigkit.validation.monitoring.watch import monitored_rig

Views = Sequence[BoardView | None]
"""What the cameras saw at one moment, one entry per camera."""


def full_rig_calibration(
    frames: Sequence[Views],
    names: Sequence[str],
    sizes_px: Sequence[tuple[int, int]],
    candidate_fits: Sequence[CandidateFits] = (),
) -> RigCalibration | None:
    """Return the full calibration from frames of the cameras `names`; None where they do not determine the rig.

    `candidate_fits` are intermediate results of `full_calibration` for single cameras, which save most of the time.
    """
    views: dict[str, list[tuple[str, BoardView]]] = {name: [] for name in names}
    for k, frame in enumerate(frames):
        for name, view in zip(names, frame, strict=True):
            if view is not None:
                views[name].append((f"{k:04d}", replace(view, image=f"{len(views[name]):04d}")))
    sizes = dict(zip(names, sizes_px, strict=True))
    try:
        return calibrate_rig(views, sizes, model="auto", board="auto", candidate_fits=candidate_fits)
    except (InputError, DegenerateError):
        return None


def remaining_errors_of_rig(rig: RigCalibration, options: GuideOptions) -> tuple[RemainingError, ...]:
    """Return the errors of a rig's calibration with their requirements: of each lens alone; of all projections, mounts
    included, at the distance of the boards; and of what is measured.

    Raises DegenerateError where that is outside all fields of view.
    """
    cameras, mounts = rig.quoted.cameras, rig.quoted.cam_from_rig
    layout, field_deg = Layout.of_cameras(cameras), options.reach.field_deg
    requirements = []
    for own, camera, at in zip(rig.cameras, cameras, layout.cameras, strict=True):
        goal = projection_goal(camera, field_deg).among(np.r_[at], layout.count)
        requirements.append(Requirement(goal, options.goal_px, own.name))
    boards = [view.cam_from_board.translation_mm for own in rig.cameras for view in own.calibration.views]
    away_mm = float(np.median(np.linalg.norm(boards, axis=-1)))
    requirements.append(Requirement(rig_goal(cameras, mounts, away_mm, field_deg), options.goal_px, "together"))
    requirements += options.lengths(cameras, mounts)
    return tuple(requirement.remaining(rig.quoted.covariance) for requirement in requirements)


@dataclass(frozen=True, eq=False)
class RigKnowledge:
    """A calibrated rig, and its errors with their requirements."""

    monitored: Monitored
    remaining: tuple[RemainingError, ...]
    options: GuideOptions

    @classmethod
    def of(cls, rig: RigCalibration, options: GuideOptions) -> Self:
        """Raises DegenerateError where what is measured is outside all fields of view."""
        return cls(monitored_rig(rig.mounted), remaining_errors_of_rig(rig, options), options)

    @cached_property
    def plan(self) -> Plan:
        """The next two frames for the error farthest from its requirement."""
        farthest, boards = max(self.remaining, key=lambda own: own.share), self.options.boards
        return Frames.of(self.monitored, boards, self.options.reach).plan(
            self.monitored, boards, farthest.requirement.goal, 2
        )

    @property
    def reached(self) -> bool:
        return all(own.reached for own in self.remaining)

    def target(self) -> tuple[str, list[Pixels | None]]:
        """Return where to hold the board next, in words and as outlines."""
        asked, names = self.plan.views[0], self.monitored.names
        first = names.index(asked.seen_by[0])
        rig_from_board = self.monitored.cam_from_rig[first].inverse() @ asked.cam_from_board
        targets: list[Pixels | None] = [None] * len(names)
        for name in asked.seen_by:
            c = names.index(name)
            held = placement(self.monitored.cameras[c], asked.board, self.monitored.cam_from_rig[c] @ rig_from_board)
            targets[c] = held.outline_px
        where = placement(asked.camera, asked.board, asked.cam_from_board)
        together = f" where {' and '.join(asked.seen_by)} see it" if len(asked.seen_by) > 1 else ""
        return f"Hold the board{together}: {where} of {names[first]}", targets

    def gain_of(self, frame: Views, *, photo: bool) -> float:
        """Return the gain of a frame, relative to that of the view asked for."""
        monitored, plan = self.monitored, self.plan
        for camera, mount, view in zip(monitored.cameras, monitored.cam_from_rig, frame, strict=True):
            if view is None:
                continue
            try:
                held = mount.inverse() @ cam_from_seen_board(camera, view.pixels, view.points())
            except (InputError, DegenerateError):
                continue
            seen = np.zeros((len(frame), 1, view.board.corner_count), dtype=bool)
            for own, other in zip(seen, frame, strict=True):
                if other is not None and other.board.board_id == view.board.board_id:
                    own[0, view.board.index(other.grid)] = True
            gained = board_information(
                monitored, view.board, held.rotation[None], held.translation_mm[None], list(seen)
            )[0]
            after = plan.goal.error(covariance_of(plan.knowledge.information + gained / monitored.fresh_sigma_px**2))
            return relative_gain(plan, float(after), photo=photo)
        return 0.0
