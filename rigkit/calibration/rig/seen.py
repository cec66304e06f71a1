"""A board as a camera of a rig saw it, and the ways in which a board that looks the same turned can be counted."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np

from rigkit.arrays import BoolArray, FloatArray, Points
from rigkit.boards import Board
from rigkit.calibration.result import Calibration
from rigkit.calibration.rig.state import Key
from rigkit.detections import BoardView
from rigkit.geometry.rigid3 import Rigid3

__all__ = ["Places", "Seen", "Sights", "board_turn", "outer_corners", "same_looks", "seen_by", "turns_of"]

Places = Mapping[str, tuple[str, Rigid3]]
"""Board -> its target and target_from_board, of the boards that are mounted to others."""


@dataclass(frozen=True, eq=False, slots=True)
class Seen:
    """A board in an image, as the camera's own calibration left it.

    Attributes
    ----------
    view, kept, cam_from_board : as in the calibration.
    squared_px : (N,) squared 2-D residuals of the corners there.
    frame : everything of this frame was taken at one moment.
    key : (frame, target), or a name of its own: everything with this key shares one pose.
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

    def counted(self, quarter_turns: int, board: Board | None = None) -> Seen:
        """Return the same with the corners counted from another corner, as those of `board` where one is given (of the
        same size, turned likewise)."""
        if quarter_turns == 0 and board is None:
            return self
        old = self.view.board
        board = old if board is None else board
        (column, row), columns, rows = self.view.grid.T, old.columns, old.rows
        for _ in range(quarter_turns):
            column, row = rows - 1 - row, column
            columns, rows = rows, columns
        grid = np.stack([column, row], axis=-1)
        pose = self.cam_from_board @ board_turn(old.size, _squares(old), quarter_turns).inverse()
        return replace(self, view=replace(self.view, grid=grid, board=board), cam_from_board=pose)


Sights = dict[tuple[str, str], Seen]
"""What a camera saw, by (frame, board)."""


def _squares(board: Board) -> tuple[float, float]:
    return (board.square_x_mm, board.square_y_mm)


@lru_cache(maxsize=256)
def board_turn(size: tuple[int, int], squares_mm: tuple[float, float], quarter_turns: int) -> Rigid3:
    """Return counted_from_old: the frame of a board whose corners are counted from another corner, from the old one."""
    angle = 0.5 * np.pi * quarter_turns
    turn = np.rint([[np.cos(angle), -np.sin(angle), 0.0], [np.sin(angle), np.cos(angle), 0.0], [0.0, 0.0, 1.0]])
    far = (np.array(size) - 1) * np.array(squares_mm)
    corners = np.array([[0.0, 0.0, 0.0], [far[0], far[1], 0.0]])
    # After the turn the grid must again begin at zero.
    return Rigid3(turn, -(corners @ turn.T).min(axis=0))


def outer_corners(board: Board) -> Points:
    """Return the four outer corners in the board's frame, (4, 3) mm."""
    far = [(board.columns - 1) * board.square_x_mm, (board.rows - 1) * board.square_y_mm, 0.0]
    return np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [1.0, 1.0, 0.0]]) * far


def same_looks(board: Board) -> tuple[int, ...]:
    """Return the quarter turns after which the board looks as before."""
    if not board.looks_same_turned:
        return (0,)
    square = board.columns == board.rows and board.columns % 2 == 0 and board.square_x_mm == board.square_y_mm
    return (0, 1, 2, 3) if square else (0, 2)


def turns_of(board: Board) -> tuple[Rigid3, ...]:
    """Return counted_from_old of every way in which the board can be counted."""
    return tuple(board_turn(board.size, _squares(board), turns) for turns in same_looks(board))


def seen_by(own: Sequence[tuple[str, BoardView]], result: Calibration) -> Sights:
    """Return the views that the camera's own calibration used; every board is a target of its own."""
    used = {(v.image, v.board_id): v for v in result.views}
    out = {}
    for frame, view in own:
        entry = used.get((view.image, view.board.board_id))
        if entry is not None:
            squared = np.nan_to_num((entry.residuals_px**2).sum(axis=1))
            key = (frame, view.board.board_id)
            out[key] = Seen(view, entry.kept, entry.cam_from_board, squared, frame, key)
    return out
