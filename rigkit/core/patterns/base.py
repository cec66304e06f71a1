"""The contract of every pattern: where its points lie, what is black, how files write it, what it looks like turned.

A board has columns x rows points on an index grid and a measured length, its "square": the side of a square or of a
tag, the distance of two circles. A pattern says the rest. Adding one is a file and a line in `registry`, and, for how
images are searched for it, a file and a line in `rigkit.detection.targets`.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from typing import ClassVar, Self, TypeAlias

import numpy as np

from rigkit.core.arrays import BoolArray, FloatArray
from rigkit.core.errors import InputError

Value: TypeAlias = str | int | float | bool


@dataclass(frozen=True, slots=True)
class Key:
    """A key that a board file has for one pattern.

    Attributes
    ----------
    name : in the file, such as "marker_mm".
    field : of the pattern that it sets.
    kind : str, int, float or bool; numbers are positive, whole numbers at least 0.
    hint : as the file writes it, for errors: "marker_mm = 22.0 (with the black border)".
    required : otherwise the field's own default holds.
    """

    name: str
    field: str
    kind: type[str] | type[int] | type[float] | type[bool]
    hint: str
    required: bool = False


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class Ink:
    """What is printed, in mm in the frame of the board.

    Attributes
    ----------
    rectangles : (M, 4) x, y, width, height. They touch, but do not overlap.
    circles : (K, 3) x and y of the centre, radius.
    first_black : of boards with (columns + 1) x (rows + 1) squares, which are not among the rectangles, whether the one
        before the first point is black; None for boards without squares.
    inverted : what is listed is white on a black ground.
    """

    rectangles: FloatArray = field(default_factory=lambda: np.zeros((0, 4)))
    circles: FloatArray = field(default_factory=lambda: np.zeros((0, 3)))
    first_black: bool | None = None
    inverted: bool = False


@dataclass(frozen=True, slots=True)
class Pattern(ABC):
    """What is printed on a board, but for how many points it has and how long a square is.

    Two patterns are equal where nothing but the counts and the size tells boards with them apart.
    """

    type: ClassVar[str]
    """Name in the registry and in board files."""
    size_word: ClassVar[str] = "square"
    """The measured length in a word: board files write it as `<word>_mm`."""
    size_meaning: ClassVar[str] = "the side of a square"
    """The measured length in words."""
    point_word: ClassVar[str] = "inner corners"
    """What a board's points are called."""
    count_word: ClassVar[str] = "inner corners"
    """What columns and rows count in board files."""
    unambiguous: ClassVar[str] = "one with an odd and an even number of corners"
    """A board of this pattern that looks otherwise when it is turned by 180 degrees."""
    identified: ClassVar[bool] = False
    """Marks in the image tell which board and which point it is: detections come named and on the board's own grid."""
    keys: ClassVar[tuple[Key, ...]] = ()
    """Keys of board files beside columns, rows and the measured length."""

    @classmethod
    def from_keys(cls, values: Mapping[str, Value]) -> Self:
        """Return the pattern of the keys (by name) that a file has; raises InputError for values that make none."""
        return cls(**{key.field: values[key.name] for key in cls.keys if key.name in values})

    def key_values(self) -> dict[str, Value]:
        """Return the keys by name, as `from_keys` reads them."""
        return {key.name: getattr(self, key.field) for key in self.keys}

    @property
    def points_per_count(self) -> int:
        """Points along a column or row for each that a person counts: two a tag."""
        return 1

    def check(self, columns: int, rows: int, squares_mm: tuple[float, float]) -> None:
        """Raise InputError where no board of so many points and such squares can have this pattern."""
        return

    @property
    def even_steps(self) -> bool:
        """Whether `positions` is the grid itself: straight rows and columns, one square apart."""
        return True

    def positions(self, grid: FloatArray) -> FloatArray:
        """Return where points (column, row) (N, 2), also between whole ones, lie in squares from the first (N, 2)."""
        return np.asarray(grid, dtype=np.float64)

    def exists(self, columns: int, rows: int) -> BoolArray:
        """Say of the index grid (rows, columns) where there is a point."""
        return np.ones((rows, columns), dtype=bool)

    def turns(self, columns: int, rows: int, even: bool) -> tuple[int, ...]:
        """Return after how many quarter turns, of 1, 2 and 3, a board looks as before; `even`: squares are square."""
        return ()

    def outline(self, columns: int, rows: int) -> tuple[FloatArray, FloatArray]:
        """Return the lower and the upper end along x and y of what is printed, in squares from the first point."""
        return np.array([-1.0, -1.0]), np.array([columns, rows], dtype=np.float64)

    @abstractmethod
    def ink(self, columns: int, rows: int, squares_mm: tuple[float, float], *, upright: bool = False) -> Ink:
        """Return what is printed on a board of so many points with squares of such sides.

        `upright` : of modules, touching ones of a column are one rectangle, else those of a row.

        Raises InputError where the pattern cannot be.
        """

    def describe(self, columns: int, rows: int, squares_mm: tuple[float, float]) -> str:
        """Return the board in words: "9 x 6 inner corners, squares 30 x 30 mm"."""
        per = self.points_per_count
        x, y = squares_mm
        return f"{columns // per} x {rows // per} {self.count_word}, {self.size_word}s {x:g} x {y:g} mm"

    def scaled(self, factor: float) -> Self:
        """Return the pattern printed larger: fields in mm grow with the squares."""
        lengths = {f.name: getattr(self, f.name) for f in fields(self) if f.name.endswith("_mm")}
        return replace(self, **{name: value * factor for name, value in lengths.items() if value is not None})


def filled_modules(black: BoolArray, *, upright: bool = False) -> FloatArray:
    """Return the black modules (R, C) as rectangles (M, 4): x, y, width, height in modules.

    Touching modules of a row are one rectangle, or those of a column (`upright`): either way all is covered once.
    """
    change = np.diff(np.pad(black.T if upright else black, ((0, 0), (1, 1))).astype(np.int8), axis=1)
    (line, start), (_, end) = np.nonzero(change == 1), np.nonzero(change == -1)
    place, extent = np.stack([start, line], axis=-1), np.stack([end - start, np.ones_like(line)], axis=-1)
    if upright:
        place, extent = place[:, ::-1], extent[:, ::-1]
    return np.concatenate([place, extent], axis=1).astype(np.float64)


def positive(value: float, what: str) -> None:
    """Raise InputError unless `value`, of `what`, is a positive number."""
    if not (np.isfinite(value) and value > 0.0):
        raise InputError(f"{what} must be positive, got {value}")
