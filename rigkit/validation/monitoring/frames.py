"""Candidate frames of a camera, or of all cameras of a rig at once, and their expected information."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from rigkit.core.arrays import BoolArray, FloatArray, IntArray, Points
from rigkit.core.boards import Board
from rigkit.core.errors import DegenerateError
from rigkit.core.reach import Reach
from rigkit.geometry.rigid3 import Rigid3
from rigkit.planning.candidates import CANDIDATES_KEPT, board_in_view, board_poses_in_view
from rigkit.planning.goal import Goal
from rigkit.planning.information import CornerError, Knowledge
from rigkit.planning.plan import Plan, Proposal, choose_views, covariance_of
from rigkit.validation.monitoring.evidence import Monitored, board_information


@dataclass(frozen=True, eq=False, slots=True)
class Frames:
    """C candidate frames.

    Attributes
    ----------
    rotation, translation_mm : (C, 3, 3) and (C, 3), of rig_from_board.
    board : (C,) index of the board.
    seen : (C, cameras) whether the camera sees the whole board.
    owner : (C,) index of the camera for which the frame was generated.
    information : (C, T, T) px^2, about theta.
    """

    rotation: FloatArray
    translation_mm: Points
    board: IntArray
    seen: BoolArray
    owner: IntArray
    information: FloatArray

    @classmethod
    def of(cls, monitored: Monitored, boards: Sequence[Board], reach: Reach) -> Frames:
        """Raises DegenerateError where no board fits into the image of any camera."""
        parts: list[Frames] = []
        refused: DegenerateError | None = None
        for number, board in enumerate(boards):
            for c in range(len(monitored.cameras)):
                try:
                    parts.append(cls._frames_of_camera(monitored, c, board, number, reach))
                except DegenerateError as error:
                    refused = error
        if not parts:
            assert refused is not None
            raise refused
        return cls(*(np.concatenate([getattr(part, name) for part in parts]) for name in cls.__slots__))

    @classmethod
    def _frames_of_camera(cls, monitored: Monitored, c: int, board: Board, number: int, reach: Reach) -> Frames:
        """Return frames in which camera `c` sees the board, spread evenly, as is every leading part of them."""
        held = board_poses_in_view(monitored.cameras[c], board, reach)
        held = held.chosen(np.arange(min(len(held), -(-CANDIDATES_KEPT // len(monitored.cameras)))))
        in_rig = held.transformed(monitored.cam_from_rig[c].inverse())
        seen = np.stack(
            [
                board_in_view(camera, board, in_rig.transformed(pose), reach)
                for camera, pose in zip(monitored.cameras, monitored.cam_from_rig, strict=True)
            ],
            axis=1,
        )
        seen[:, c] = True
        corners = [np.tile(own[:, None], board.corner_count) for own in seen.T]
        count = np.ones(len(held), dtype=np.int64)
        gained = board_information(monitored, board, in_rig.rotation, in_rig.translation_mm, corners)
        return cls(in_rig.rotation, in_rig.translation_mm, number * count, seen, c * count, gained)

    def plan(self, monitored: Monitored, boards: Sequence[Board], goal: Goal, count: int) -> Plan:
        """Return the `count` frames that lower the goal's error most, with the overdispersion of the calibration."""
        inverse, sigma = covariance_of(monitored.covariance), monitored.fresh_sigma_px
        taken, errors = choose_views(inverse, self.information / sigma**2, goal, count)
        known = Knowledge(monitored.cameras[0], inverse, CornerError(sigma))
        views = self.proposals(monitored, boards, taken, errors)
        return Plan(known, goal, float(goal.error(monitored.covariance)), views)

    def proposals(
        self, monitored: Monitored, boards: Sequence[Board], taken: Sequence[int], errors: Sequence[float]
    ) -> tuple[Proposal, ...]:
        """Return the frames of indices `taken`, with the `errors` after them, as views of their owners."""
        return tuple(
            self._proposal(k, monitored, boards[self.board[k]], error) for k, error in zip(taken, errors, strict=True)
        )

    def _proposal(self, index: int, monitored: Monitored, board: Board, error: float) -> Proposal:
        c = int(self.owner[index])
        rig_from_board = Rigid3(self.rotation[index], self.translation_mm[index])
        names = [monitored.names[c], *(n for k, n in enumerate(monitored.names) if self.seen[index, k] and k != c)]
        return Proposal(
            board,
            monitored.cam_from_rig[c] @ rig_from_board,
            error,
            monitored.cameras[c],
            tuple(names) if monitored.is_rig else (),
        )
