"""Calibration boards as declared by a person, with the positions of their points."""

from __future__ import annotations

from dataclasses import KW_ONLY, dataclass, field, replace

import numpy as np

from rigkit.core.arrays import IntArray, Points
from rigkit.core.errors import InputError
from rigkit.core.identifiers import check_identifier
from rigkit.core.patterns.base import Ink, Pattern
from rigkit.core.patterns.chessboard import Chessboard


@dataclass(frozen=True, eq=False, slots=True)
class Board:
    """A board of `columns` x `rows` points: the INNER corners of a chessboard, the corners of tags, centres of circles.

    Frame: origin at the first point, x along the columns, y along the rows, z into the board, so that the axes of a
    camera in front of the board are parallel to the board's.

    Attributes
    ----------
    board_id : name in manifests, clouds and tables.
    columns, rows : points along x and y.
    square_x_mm, square_y_mm : measured side of a square; of a tag on an AprilGrid.
    square_sigma_mm : standard deviation of that measurement, if stated.
    pattern : what is printed.

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
    _: KW_ONLY
    square_sigma_mm: float | None = None
    pattern: Pattern = field(default_factory=Chessboard)

    def __post_init__(self) -> None:
        check_identifier(self.board_id, "board")
        if not all(isinstance(count, int | np.integer) for count in (self.columns, self.rows)):
            got = f"{self.columns!r} and {self.rows!r}"
            raise InputError(f"board '{self.board_id}': columns and rows must be whole numbers, got {got}")
        if self.columns < 2 or self.rows < 2:
            words = self.pattern.point_word
            raise InputError(f"board '{self.board_id}': at least 2x2 {words}, got {self.columns}x{self.rows}")
        for side in self.squares_mm:
            if not 0.0 < side < np.inf:
                word = self.pattern.size_word
                raise InputError(f"board '{self.board_id}': the {word} size must be positive, got {side} mm")
        sigma = self.square_sigma_mm
        if sigma is not None and not 0.0 <= sigma < np.inf:
            raise InputError(f"board '{self.board_id}': {self.pattern.size_word}_sigma_mm cannot be {sigma}")
        try:
            self.pattern.check(self.columns, self.rows, self.squares_mm)
        except InputError as error:
            raise InputError(f"board '{self.board_id}': {error}") from error

    @property
    def size(self) -> tuple[int, int]:
        """(columns, rows)."""
        return (self.columns, self.rows)

    @property
    def squares_mm(self) -> tuple[float, float]:
        """(square_x_mm, square_y_mm)."""
        return (self.square_x_mm, self.square_y_mm)

    @property
    def corner_count(self) -> int:
        """Number of points."""
        return self.columns * self.rows

    @property
    def identified(self) -> bool:
        """Whether markers identify the board and its points in an image."""
        return self.pattern.identified

    @property
    def turns(self) -> tuple[int, ...]:
        """The rotational symmetries of the board, as quarter turns of 1, 2 and 3."""
        return self.pattern.turns(self.columns, self.rows, self.square_x_mm == self.square_y_mm)

    @property
    def looks_same_turned(self) -> bool:
        """Whether the board is symmetric under a rotation by 180 degrees, so that its first corner is ambiguous."""
        return 2 in self.turns

    def grid(self) -> IntArray:
        """Return (column, row) of all points, (columns * rows, 2), row by row."""
        row, column = np.divmod(np.arange(self.corner_count), self.columns)
        return np.stack([column, row], axis=-1)

    def index(self, grid: IntArray) -> IntArray:
        """Return the indices (N,) of points `grid` (N, 2) in `grid()` and `points()`."""
        return np.asarray(grid[:, 1] * self.columns + grid[:, 0], dtype=np.int64)

    def points(self, grid: IntArray | None = None) -> Points:
        """Return the points `grid` (N, 2; all by default) in the board frame, (N, 3) mm."""
        chosen = self.pattern.positions(np.asarray(self.grid() if grid is None else grid, dtype=np.float64))
        return np.concatenate([chosen * np.array(self.squares_mm), np.zeros((len(chosen), 1))], axis=1)

    def ink(self, *, upright: bool = False) -> Ink:
        """Return what is printed on the board, as `Pattern.ink`; raises InputError where the pattern is impossible."""
        try:
            return self.pattern.ink(self.columns, self.rows, self.squares_mm, upright=upright)
        except InputError as error:
            raise InputError(f"board '{self.board_id}': {error}") from error

    def describe(self) -> str:
        """Return the board in words: "9 x 6 inner corners, squares 30 x 30 mm"."""
        return self.pattern.describe(self.columns, self.rows, self.squares_mm)

    def with_squares(self, x_mm: float, y_mm: float) -> Board:
        """Return the board with squares of another size, and the pattern scaled with them."""
        growth = (x_mm / self.square_x_mm + y_mm / self.square_y_mm) / 2.0
        return replace(self, square_x_mm=x_mm, square_y_mm=y_mm, pattern=self.pattern.scaled(growth))
