"""Circle grids: the centres of circles in regular or staggered rows."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar, Self

import numpy as np

from rigkit.core.arrays import FloatArray
from rigkit.core.errors import InputError
from rigkit.core.patterns.base import Ink, Key, Pattern, Value

ROW_STEPS = {"regular": 1.0, "asymmetric": 0.5, "hexagonal": float(np.sqrt(0.75))}
"""Distance of two rows, in distances of two circles of a row."""
NEIGHBOUR_DISTANCES = {"regular": 1.0, "asymmetric": float(np.sqrt(0.5)), "hexagonal": 1.0}
"""Distance of nearest neighbours, in the same unit."""
STAGGERS = ("right", "left")
TYPICAL_DIAMETER = 0.6
"""Default diameter for printing, in distances of nearest neighbours."""


@dataclass(frozen=True, slots=True)
class Circles(Pattern):
    """Columns x rows of circles; in staggered layouts every second row, from the second, is shifted by half a step.

    The measured length is the distance of two circles in a row. OpenCV's asymmetric grid of 4 x 11 with `squareSize` s
    has columns 4, rows 11 and a distance of 2 s.

    Attributes
    ----------
    layout : "regular"; "asymmetric", staggered with rows half a distance apart, a square lattice rotated by 45 degrees;
        or "hexagonal", staggered with six equidistant neighbours.
    diameter_mm : of the circles; not needed for detection.
    stagger : whether every second row, from the second, is shifted to the "right" or to the "left".
    inverted : whether circles are white on black.
    """

    type: ClassVar[str] = "circles"
    size_word: ClassVar[str] = "distance"
    size_meaning: ClassVar[str] = "the distance of two circles in a row"
    unambiguous: ClassVar[str] = "an asymmetric or hexagonal one with an odd number of rows"
    point_word: ClassVar[str] = "circles"
    count_word: ClassVar[str] = "circles"
    keys: ClassVar[tuple[Key, ...]] = (
        Key("layout", "layout", str, 'layout = "regular" (or "asymmetric", "hexagonal")'),
        Key("stagger", "stagger", str, 'stagger = "right" (or "left": the second row begins half a step further left)'),
        Key("diameter_mm", "diameter_mm", float, "diameter_mm = 15.0"),
        Key("inverted", "inverted", bool, "inverted = false (true: white circles on black)"),
    )

    layout: str = "regular"
    stagger: str = "right"
    diameter_mm: float | None = None
    inverted: bool = False

    @classmethod
    def from_keys(cls, values: Mapping[str, Value]) -> Self:
        for key, typical, known in (("layout", "regular", tuple(ROW_STEPS)), ("stagger", "right", STAGGERS)):
            if values.get(key, typical) not in known:
                raise InputError(f"{key} '{values[key]}' is unknown; known: {', '.join(known)}")
        return super(Circles, cls).from_keys(values)

    def key_values(self) -> dict[str, Value]:
        known: dict[str, Value] = {"layout": self.layout, "inverted": self.inverted}
        if self.staggered:
            known["stagger"] = self.stagger
        return known if self.diameter_mm is None else {**known, "diameter_mm": self.diameter_mm}

    @property
    def staggered(self) -> bool:
        return self.layout != "regular"

    @property
    def even_steps(self) -> bool:
        return not self.staggered

    def check(self, columns: int, rows: int, squares_mm: tuple[float, float]) -> None:
        nearest = self.nearest_mm(squares_mm)
        if self.diameter_mm is not None and not 0.0 < self.diameter_mm < nearest:
            raise InputError(
                f"circles of {self.diameter_mm:g} mm touch: neighbours lie {nearest:g} mm apart; distance_mm is that "
                "of two circles in a row, diameter_mm that of one circle"
            )

    def positions(self, grid: FloatArray) -> FloatArray:
        column, row = np.asarray(grid, dtype=np.float64).T
        # 0 in even rows, half a step in odd ones.
        half = 0.0 if not self.staggered else 0.5 if self.stagger == "right" else -0.5
        shift = half * (1.0 - np.abs(1.0 - np.mod(row, 2.0)))
        return np.stack([column + shift, row * ROW_STEPS[self.layout]], axis=-1)

    def turns(self, columns: int, rows: int, even: bool) -> tuple[int, ...]:
        if self.staggered:
            return (2,) if rows % 2 == 0 else ()
        return (1, 2, 3) if even and columns == rows else (2,)

    def outline(self, columns: int, rows: int) -> tuple[FloatArray, FloatArray]:
        # Black ground needs a margin around the circles, as paper has.
        half = (1.0 if self.inverted else 0.5) * NEIGHBOUR_DISTANCES[self.layout]
        # The extreme points are in the first two rows along x, in the last row along y.
        ends = self.positions(np.array([[0, 0], [0, 1], [columns - 1, 0], [columns - 1, 1], [0, rows - 1]]))
        return ends.min(axis=0) - half, ends.max(axis=0) + half

    def ink(self, columns: int, rows: int, squares_mm: tuple[float, float], *, upright: bool = False) -> Ink:
        row, column = np.divmod(np.arange(columns * rows), columns)
        centres = self.positions(np.stack([column, row], axis=-1)) * squares_mm
        radius = np.full((len(centres), 1), 0.5 * self.printed_diameter_mm(squares_mm))
        return Ink(circles=np.concatenate([centres, radius], axis=1), inverted=self.inverted)

    def printed_diameter_mm(self, squares_mm: tuple[float, float]) -> float:
        """Return the diameter of the circles, the default if it is not given."""
        return TYPICAL_DIAMETER * self.nearest_mm(squares_mm) if self.diameter_mm is None else self.diameter_mm

    def nearest_mm(self, squares_mm: tuple[float, float]) -> float:
        """Return the distance of a circle's nearest neighbours."""
        return NEIGHBOUR_DISTANCES[self.layout] * min(squares_mm)

    def describe(self, columns: int, rows: int, squares_mm: tuple[float, float]) -> str:
        x, y = squares_mm
        colour = "white on black" if self.inverted else "black on white"
        across = f", diameter {self.diameter_mm:g} mm" if self.diameter_mm is not None else ""
        return f"{columns} x {rows} circles, {self.layout}, distance {x:g} x {y:g} mm{across}, {colour}"
