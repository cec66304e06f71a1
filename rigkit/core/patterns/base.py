"""The interface of every pattern: positions of points, print, keys in board files, symmetries.

A board has columns x rows points on an index grid and a measured length, its "square": the side of a square or of a
tag, the distance of two circles. A pattern defines the rest. Adding one is a file and a line in `registry` and, for its
detection, a file and a line in `rigkit.detection.targets`.
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
    """A key in board files for one pattern.

    Attributes
    ----------
    name : in the file, such as "marker_mm".
    field : the field of the pattern that it sets.
    kind : str, int, float or bool; floats are positive, integers at least 0.
    hint : example for error messages: "marker_mm = 22.0 (with the black border)".
    required : whether it has to be given; otherwise the field has a default.
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
    rectangles : (M, 4) x, y, width, height; they may touch, but do not overlap.
    circles : (K, 3) x and y of the centre, radius.
    first_black : for boards with (columns + 1) x (rows + 1) squares, which are not among the rectangles: whether the
        square before the first point is black; None for boards without squares.
    inverted : whether all this is white on black.
    """

    rectangles: FloatArray = field(default_factory=lambda: np.zeros((0, 4)))
    circles: FloatArray = field(default_factory=lambda: np.zeros((0, 3)))
    first_black: bool | None = None
    inverted: bool = False


@dataclass(frozen=True, slots=True)
class Pattern(ABC):
    """What is printed on a board, apart from the number of points and the length of a square.

    Boards with equal patterns differ at most in counts and size.
    """

    type: ClassVar[str]
    """Name in the registry and in board files."""
    size_word: ClassVar[str] = "square"
    """Name of the measured length, in board files `<word>_mm`."""
    size_meaning: ClassVar[str] = "the side of a square"
    """Definition of the measured length."""
    point_word: ClassVar[str] = "inner corners"
    """Name of the points."""
    count_word: ClassVar[str] = "inner corners"
    """What columns and rows count in board files."""
    unambiguous: ClassVar[str] = "one with an odd and an even number of corners"
    """A board of this pattern without symmetry under a rotation by 180 degrees."""
    identified: ClassVar[bool] = False
    """Whether markers identify board and points in an image, so that detections have the board's name and grid."""
    keys: ClassVar[tuple[Key, ...]] = ()
    """Keys of board files besides columns, rows and the measured length."""

    @classmethod
    def from_keys(cls, values: Mapping[str, Value]) -> Self:
        """Return the pattern from the values of a file's keys, by name; raises InputError for invalid values."""
        return cls(**{key.field: values[key.name] for key in cls.keys if key.name in values})

    def key_values(self) -> dict[str, Value]:
        """Return the keys by name, as `from_keys` reads them."""
        return {key.name: getattr(self, key.field) for key in self.keys}

    @property
    def points_per_count(self) -> int:
        """Number of points along a row for each column counted in board files: two for a tag."""
        return 1

    def check(self, columns: int, rows: int, squares_mm: tuple[float, float]) -> None:
        """Raise InputError if a board with so many points and such squares cannot have this pattern."""
        return

    @property
    def even_steps(self) -> bool:
        """Whether `positions` is the identity: straight rows and columns, one square apart."""
        return True

    def positions(self, grid: FloatArray) -> FloatArray:
        """Return the positions (N, 2) of points (column, row) (N, 2), also fractional ones, in squares from the
        first."""
        return np.asarray(grid, dtype=np.float64)

    def turns(self, columns: int, rows: int, even: bool) -> tuple[int, ...]:
        """Return the rotational symmetries as quarter turns of 1, 2 and 3; `even`: both sides of a square are equal."""
        return ()

    def outline(self, columns: int, rows: int) -> tuple[FloatArray, FloatArray]:
        """Return the bounding box of the print, lower and upper (x, y), in squares from the first point."""
        return np.array([-1.0, -1.0]), np.array([columns, rows], dtype=np.float64)

    @abstractmethod
    def ink(self, columns: int, rows: int, squares_mm: tuple[float, float], *, upright: bool = False) -> Ink:
        """Return what is printed on a board of so many points with such squares.

        `upright` : whether touching modules of a column make one rectangle, instead of those of a row.

        Raises InputError where the pattern is impossible.
        """

    def describe(self, columns: int, rows: int, squares_mm: tuple[float, float]) -> str:
        """Return the board in words: "9 x 6 inner corners, squares 30 x 30 mm"."""
        per = self.points_per_count
        x, y = squares_mm
        return f"{columns // per} x {rows // per} {self.count_word}, {self.size_word}s {x:g} x {y:g} mm"

    def scaled(self, factor: float) -> Self:
        """Return the pattern with all fields in mm scaled."""
        lengths = {f.name: getattr(self, f.name) for f in fields(self) if f.name.endswith("_mm")}
        return replace(self, **{name: value * factor for name, value in lengths.items() if value is not None})


def filled_modules(black: BoolArray, *, upright: bool = False) -> FloatArray:
    """Return the black modules (R, C) as rectangles (M, 4): x, y, width, height in modules.

    Touching modules of a row, or of a column (`upright`), make one rectangle; rectangles do not overlap.
    """
    change = np.diff(np.pad(black.T if upright else black, ((0, 0), (1, 1))).astype(np.int8), axis=1)
    (line, start), (_, end) = np.nonzero(change == 1), np.nonzero(change == -1)
    place, extent = np.stack([start, line], axis=-1), np.stack([end - start, np.ones_like(line)], axis=-1)
    if upright:
        place, extent = place[:, ::-1], extent[:, ::-1]
    return np.concatenate([place, extent], axis=1).astype(np.float64)


def positive(value: float, what: str) -> None:
    """Raise InputError, with `what` in the message, unless `value` is a positive number."""
    if not (np.isfinite(value) and value > 0.0):
        raise InputError(f"{what} must be positive, got {value}")
