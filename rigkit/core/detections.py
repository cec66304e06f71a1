"""Detected corners of boards in images."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from rigkit.core.arrays import FloatArray, IntArray, Pixels, Points, keep_arrays, keep_indices
from rigkit.core.boards import Board
from rigkit.core.errors import InputError
from rigkit.core.printing import brief


def grid_turned(grid: IntArray, size: tuple[int, int], quarter_turns: int) -> IntArray:
    """Return (column, row) (N, 2) of corners after numbering the grid from another corner, by `quarter_turns` x 90
    degrees. One turn maps (column, row) to (rows - 1 - row, column), which keeps the grid right-handed. `size` is
    (columns, rows) before the turn.

    >>> grid_turned(np.array([[0, 0], [2, 1]]), (3, 2), 1).tolist()
    [[1, 0], [0, 2]]
    """
    (column, row), (columns, rows) = grid.T, size
    for _ in range(quarter_turns % 4):
        column, row = rows - 1 - row, column
        columns, rows = rows, columns
    out = np.empty(grid.shape, grid.dtype)
    out[:, 0], out[:, 1] = column, row
    return out


def _check_corners(seen: BoardDetection | BoardView) -> None:
    """Replace grid, pixels and sigmas by read-only arrays; raises InputError unless they have one length."""
    keep_indices(seen, grid=(None, 2))
    n = len(seen.grid)
    keep_arrays(seen, pixels=(n, 2), sigma_px=(n,))


@dataclass(frozen=True, eq=False, slots=True)
class BoardDetection:
    """Corners of one board in one image.

    Attributes
    ----------
    board_id : the board's name; None if unknown (several boards of one size, or no size given).
    columns, rows : size of the grid found, or of the board if that is known.
    grid : (N, 2) int, (column, row) of each corner, right-handed (x right, y down, z away from the viewer), sorted row
        by row. Corners may be missing.
    pixels : (N, 2)
    sigma_px : (N,) predicted standard deviation per axis.
    """

    board_id: str | None
    columns: int
    rows: int
    grid: IntArray
    pixels: Pixels
    sigma_px: FloatArray

    __repr__ = brief

    def __post_init__(self) -> None:
        _check_corners(self)
        inside = (self.grid >= 0).all() and (self.grid < [self.columns, self.rows]).all()
        if not inside:
            raise InputError(
                f"board detection: a corner lies outside the {self.columns}x{self.rows} grid; "
                "correct its column and row"
            )

    @property
    def complete(self) -> bool:
        return len(self.grid) == self.columns * self.rows

    def turned(self, quarter_turns: int) -> BoardDetection:
        """Return the same corners with the first corner moved by `quarter_turns` x 90 degrees (still right-handed)."""
        size = (self.columns, self.rows)
        grid = grid_turned(self.grid, size, quarter_turns)
        order = np.lexsort(grid.T)
        columns, rows = size if quarter_turns % 2 == 0 else size[::-1]
        return BoardDetection(self.board_id, columns, rows, grid[order], self.pixels[order], self.sigma_px[order])

    def named(self, board_id: str) -> BoardDetection:
        # Without checks: the corners were checked before, and do not change.
        out = object.__new__(BoardDetection)
        for name in self.__slots__:
            object.__setattr__(out, name, board_id if name == "board_id" else getattr(self, name))
        return out

    def lattice(self) -> FloatArray:
        """Return the pixels as (rows, columns, 2), NaN where a corner was not found."""
        out = np.full((self.rows, self.columns, 2), np.nan)
        out[self.grid[:, 1], self.grid[:, 0]] = self.pixels
        return out


@dataclass(frozen=True, eq=False, slots=True)
class BoardView:
    """One board in one image with its object points: the unit of calibration.

    Attributes
    ----------
    image : name of the image, for reports.
    board : the board.
    grid : (N, 2) int corner indices.
    pixels : (N, 2)
    sigma_px : (N,)
    points_mm : (N, 3) the corners in the board frame, where a calibration measured them; None: as declared, flat.
    """

    image: str
    board: Board
    grid: IntArray
    pixels: Pixels
    sigma_px: FloatArray
    points_mm: Points | None = None

    __repr__ = brief

    def __post_init__(self) -> None:
        _check_corners(self)
        if self.points_mm is not None:
            keep_arrays(self, points_mm=(len(self.grid), 3))

    @classmethod
    def from_detection(cls, image: str, detection: BoardDetection, boards: Sequence[Board]) -> BoardView:
        """Return the view of a detection with its board, by name; raises InputError if none of `boards` has it."""
        for board in boards:
            if board.board_id == detection.board_id:
                return cls(image, board, detection.grid, detection.pixels, detection.sigma_px)
        known = ", ".join(board.board_id for board in boards)
        raise InputError(f"image '{image}': no board is called '{detection.board_id}'; known: {known}")

    def points(self) -> Points:
        """Return the corners in the board frame, (N, 3) mm."""
        return self.board.points(self.grid) if self.points_mm is None else self.points_mm


def common_corners(detection1: BoardDetection, detection2: BoardDetection) -> tuple[IntArray, IntArray, IntArray]:
    """Return grid (N, 2) of the corners seen in both, row by row, and their indices (N,) into either detection.

    >>> d = BoardDetection("a", 3, 2, [[0, 0], [1, 0], [2, 1]], np.zeros((3, 2)), np.ones(3))
    >>> e = BoardDetection("a", 3, 2, [[1, 0], [0, 1], [2, 1]], np.zeros((3, 2)), np.ones(3))
    >>> grid, first, second = common_corners(d, e)
    >>> grid.tolist(), first.tolist(), second.tolist()
    ([[1, 0], [2, 1]], [1, 2], [0, 2])
    """
    width = max(detection1.columns, detection2.columns)
    keys = [d.grid[:, 1] * width + d.grid[:, 0] for d in (detection1, detection2)]
    _, first, second = np.intersect1d(keys[0], keys[1], assume_unique=True, return_indices=True)
    return detection1.grid[first], first, second
