"""The solved shape of a board."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np

from rigkit.core.arrays import IntArray, Points, keep_arrays
from rigkit.core.boards import Board
from rigkit.core.errors import InputError

MAX_OFF_LATTICE = 0.25
"""Of a square: corners of a real board, however bent, are within this distance of the best flat lattice."""


@dataclass(frozen=True, eq=False, slots=True)
class BoardShape:
    """The solved corners of a board.

    Attributes
    ----------
    board_id : name of the board.
    kind : "flat", "warp" (print scale and a low-order bow) or "released" (every corner free under a prior).
    points_mm : (columns * rows, 3) corners in the board frame, row by row.
    bow_mm : largest departure from a plane.
    aspect : ratio of the stretches along x and along y against the declared squares, minus 1.
    declared : the declared board; None in a calibration read from an old file, which does not contain it.
    """

    board_id: str
    kind: str
    points_mm: Points
    bow_mm: float = 0.0
    aspect: float = 0.0
    declared: Board | None = None

    def __post_init__(self) -> None:
        keep_arrays(self, points_mm=(None, 3))
        if self.declared is not None and self.declared.corner_count != len(self.points_mm):
            raise InputError(
                f"board '{self.board_id}': {len(self.points_mm)} corners, but {self.declared.corner_count} are declared"
            )

    def __repr__(self) -> str:
        return (
            f"BoardShape('{self.board_id}', {self.kind}: {len(self.points_mm)} corners, off a plane by "
            f"{self.bow_mm:.3f} mm, x longer than y by {100.0 * self.aspect:.3f} %)"
        )

    @classmethod
    def of(cls, board: Board, kind: str, points_mm: Points) -> BoardShape:
        """Return the shape of `board` with its corners at `points_mm` (N, 3), bow and aspect computed from them."""
        if kind == "flat":
            return cls(board.board_id, kind, points_mm, declared=board)
        centred = points_mm - points_mm.mean(axis=0)
        normal = np.linalg.svd(centred, full_matrices=False)[2][2]
        bow = float(np.abs(centred @ normal).max())
        along_x, along_y = _stretch(board, points_mm)
        return cls(board.board_id, kind, points_mm, bow, along_x / along_y - 1.0, board)

    def at(self, grid: IntArray) -> Points:
        """Return the corners (N, 3) at grid places (N, 2), (column, row)."""
        return np.asarray(self.points_mm[grid @ np.array([1, self.column_count])])

    @property
    def column_count(self) -> int:
        """Number of corners in a row."""
        return self.board.columns if self.declared is None else self.declared.columns

    @property
    def board(self) -> Board:
        """The flat board that fits the solved corners best. One without a declaration is read as a chessboard whose
        corners are listed row by row."""
        if self.declared is None:
            return _chessboard_of(self.board_id, self.points_mm)
        named = replace(self.declared, board_id=self.board_id)
        if self.kind == "flat":
            return named
        along_x, along_y = _stretch(named, self.points_mm)
        return named.with_squares(along_x * named.square_x_mm, along_y * named.square_y_mm)


def measured_shape(shapes: Iterable[BoardShape], board: Board, *, across: bool = False) -> BoardShape | None:
    """Return the measured shape of the one board that was declared as `board` is, under any name; None if there is
    none, or several. With `across`: as `board` is with rows for columns."""
    same = [s for s in shapes if s.kind != "flat" and s.declared and declared_alike(s.declared, board, across=across)]
    return same[0] if len(same) == 1 else None


def declared_alike(known: Board, board: Board, *, across: bool = False) -> bool:
    """Return whether two boards have the same size, squares and pattern, whatever their names and sigmas; with
    `across`: one with rows for columns."""
    size, squares = (board.size[::-1], board.squares_mm[::-1]) if across else (board.size, board.squares_mm)
    return (known.size, known.squares_mm, known.pattern) == (size, squares, board.pattern)


def _stretch(board: Board, points_mm: Points) -> tuple[float, float]:
    """Return the stretch factors along x and along y of points (N, 3) mm against the declared board."""
    centred = points_mm - points_mm.mean(axis=0)
    flat = board.points() - board.points().mean(axis=0)
    along_x, along_y = (flat * centred).sum(axis=0)[:2] / (flat**2).sum(axis=0)[:2]
    return float(along_x), float(along_y)


def _chessboard_of(board_id: str, points_mm: Points) -> Board:
    """Return the chessboard with corners `points_mm` (N, 3), row by row; raises InputError if they are no lattice."""
    back = np.flatnonzero(np.diff(points_mm[:, 0]) < 0.0)
    columns = int(back[0]) + 1 if len(back) else len(points_mm)
    rows = len(points_mm) // max(columns, 1)
    fault = f"board '{board_id}': its {len(points_mm)} points are no grid, row by row; calibrate again"
    if min(columns, rows) < 2 or rows * columns != len(points_mm):
        raise InputError(fault)
    lattice = points_mm.reshape(rows, columns, 3)
    steps = [np.diff(lattice, axis=axis) for axis in (1, 0)]
    square_x, square_y = (float(np.linalg.norm(step, axis=-1).mean()) for step in steps)
    across, down = (step.mean(axis=(0, 1)) for step in steps)
    flat = lattice[0, 0] + np.arange(columns)[:, None] * across + np.arange(rows)[:, None, None] * down
    if not np.linalg.norm(lattice - flat, axis=-1).max() < MAX_OFF_LATTICE * min(square_x, square_y):
        raise InputError(fault)
    return Board(board_id, columns, rows, square_x, square_y)
