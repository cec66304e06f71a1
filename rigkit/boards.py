"""Chessboards as a person measured them, and where their corners lie."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rigkit.arrays import IntArray, Points
from rigkit.errors import InputError

__all__ = ["Board"]


@dataclass(frozen=True, eq=False, slots=True)
class Board:
    """A chessboard of `columns` x `rows` INNER corners.

    Frame: origin at the first inner corner, x along the columns, y along the rows, z into the board (so a camera that
    looks at the board's face sees x, y, z right-handed like its own axes).

    Attributes
    ----------
    board_id : name in manifests, clouds and tables.
    columns, rows : inner corners along x and y.
    square_x_mm, square_y_mm : measured side of a square.
    square_sigma_mm : standard deviation of that measurement, if stated.

    >>> Board("a", 8, 6, 50.0, 50.0).looks_same_turned
    True
    >>> Board("a", 9, 6, 30.0, 30.0).corner_count
    54
    """

    board_id: str
    columns: int
    rows: int
    square_x_mm: float
    square_y_mm: float
    square_sigma_mm: float | None = None

    def __post_init__(self) -> None:
        if self.columns < 2 or self.rows < 2:
            raise InputError(f"board '{self.board_id}': at least 2x2 inner corners, got {self.columns}x{self.rows}")
        for side in (self.square_x_mm, self.square_y_mm):
            if not (np.isfinite(side) and side > 0.0):
                raise InputError(f"board '{self.board_id}': the square size must be positive, got {side} mm")

    @property
    def size(self) -> tuple[int, int]:
        """(columns, rows)."""
        return (self.columns, self.rows)

    @property
    def corner_count(self) -> int:
        return self.columns * self.rows

    @property
    def looks_same_turned(self) -> bool:
        """Whether the board looks the same turned by 180 degrees: then no single image can tell its first corner."""
        return (self.columns + self.rows) % 2 == 0

    def grid(self) -> IntArray:
        """Return (column, row) of all corners, (columns * rows, 2), row by row."""
        row, column = np.divmod(np.arange(self.corner_count), self.columns)
        return np.stack([column, row], axis=-1)

    def points(self, grid: IntArray | None = None) -> Points:
        """Return the corners `grid` (N, 2; all by default) in the board frame, (N, 3) mm."""
        chosen = self.grid() if grid is None else np.asarray(grid)
        scale = np.array([self.square_x_mm, self.square_y_mm])
        return np.concatenate([chosen * scale, np.zeros((len(chosen), 1))], axis=1)
