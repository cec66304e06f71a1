"""Observations of boards by the cameras of a rig, and the orientations of boards with rotational symmetry."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from rigkit.calibration.choosing.board_orientation import board_turn
from rigkit.calibration.result import Calibration
from rigkit.calibration.rig.solving.state import Key
from rigkit.cameras.base import Camera
from rigkit.core.arrays import BoolArray, FloatArray, Points
from rigkit.core.boards import Board
from rigkit.core.detections import BoardView, grid_turned
from rigkit.geometry.rigid3 import Rigid3

Places = Mapping[str, tuple[str, Rigid3]]
"""Board -> its target and target_from_board, for boards mounted to others."""


@dataclass(frozen=True, eq=False, slots=True)
class Observation:
    """A board in an image, with its result in the camera's own calibration.

    Attributes
    ----------
    view, kept, cam_from_board : as in the calibration.
    squared_px : (N,) squared 2-D residuals of the corners.
    frame : images of one frame were taken at one moment.
    key : (frame, target), or a unique key: views with the same key share one pose.
    """

    view: BoardView
    kept: BoolArray
    cam_from_board: Rigid3
    squared_px: FloatArray
    frame: str
    key: Key

    @property
    def board_id(self) -> str:
        return self.view.board.board_id

    @property
    def is_alone(self) -> bool:
        """Whether no other view shares its pose, whatever it shows."""
        return self.key[0] != self.frame

    def alone(self, camera: int) -> Observation:
        """Return the observation with a pose of its own, as one of the camera of this number."""
        return replace(self, key=(f"{self.frame}, camera {camera + 1} alone", self.board_id))

    def turned(self, quarter_turns: int, board: Board | None = None) -> Observation:
        """Return the observation with the board numbered from another corner, and as that of `board` if given, which
        has to have the size after the turn."""
        if quarter_turns == 0 and board is None:
            return self
        old = self.view.board
        view = replace(
            self.view,
            grid=grid_turned(self.view.grid, old.size, quarter_turns),
            board=old if board is None else board,
        )
        return replace(self, view=view, cam_from_board=self.cam_from_board @ board_turn(old, quarter_turns).inverse())


FrameObservations = dict[tuple[str, str], Observation]
"""Observations of a camera, by (frame, board)."""


@dataclass(frozen=True, eq=False, slots=True)
class RigViews:
    """The input of a rig calibration.

    Attributes
    ----------
    names, seen, single : name, observations, and own calibration of every camera.
    places : of the boards that are mounted to others.
    """

    names: Sequence[str]
    seen: Sequence[FrameObservations]
    single: tuple[Calibration, ...]
    places: Places

    @property
    def cameras(self) -> list[Camera]:
        """The `near` cameras of the single calibrations."""
        return [alone.near for alone in self.single]

    def with_seen(self, seen: Sequence[FrameObservations]) -> RigViews:
        """Return the views with other observations of all cameras."""
        return replace(self, seen=seen)

    def with_camera(self, k: int, seen: FrameObservations) -> RigViews:
        """Return the views with other observations of camera `k`."""
        return self.with_seen([*self.seen[:k], seen, *self.seen[k + 1 :]])


def outer_corners(board: Board) -> Points:
    """Return the four outer corners in the board's frame, (4, 3) mm."""
    far = [(board.columns - 1) * board.square_x_mm, (board.rows - 1) * board.square_y_mm, 0.0]
    return np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [1.0, 1.0, 0.0]]) * far


def frame_observations(own: Sequence[tuple[str, BoardView]], result: Calibration) -> FrameObservations:
    """Return the views used in the camera's own calibration, with its numbering; every board is its own target."""
    every = np.nan_to_num((result.corners.residuals_px**2).sum(axis=1))
    each = np.split(every, np.cumsum(result.corners.count)[:-1])
    used = {(v.image, v.board_id): (v, squared) for v, squared in zip(result.views, each, strict=True)}
    out = {}
    for frame, view in own:
        found = used.get((view.image, view.board.board_id))
        if found is not None:
            entry, squared = found
            if (view.grid != entry.grid).any():
                view = replace(view, grid=entry.grid)
            key = (frame, view.board.board_id)
            out[key] = Observation(view, entry.kept, entry.cam_from_board, squared, frame, key)
    return out
