"""ChArUco boards: chessboards with ArUco markers in their white squares."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from rigkit.core.arrays import IntArray
from rigkit.core.errors import InputError
from rigkit.core.patterns.aruco import dictionary_modules
from rigkit.core.patterns.base import Ink, Key, Pattern, filled_modules


@dataclass(frozen=True, slots=True)
class Charuco(Pattern):
    """Markers in the white squares of a chessboard, numbered row by row.

    Attributes
    ----------
    dictionary : name in OpenCV, such as "DICT_5X5_100".
    marker_mm : side of a marker with its black border.
    first_marker : number of the first marker; boards in one image need different markers or dictionaries.
    legacy : layout of OpenCV before 4.6: with an even number of rows of squares the first square is white.
    inverted : whether black and white are exchanged.
    """

    type: ClassVar[str] = "charuco"
    identified: ClassVar[bool] = True
    keys: ClassVar[tuple[Key, ...]] = (
        Key("dictionary", "dictionary", str, 'dictionary = "DICT_5X5_100"', required=True),
        Key("marker_mm", "marker_mm", float, "marker_mm = 22.0 (with the black border)", required=True),
        Key("first_marker", "first_marker", int, "first_marker = 0"),
        Key("legacy_pattern", "legacy", bool, "legacy_pattern = false"),
        Key("inverted", "inverted", bool, "inverted = false (true: black and white exchanged)"),
    )

    dictionary: str
    marker_mm: float
    first_marker: int = 0
    legacy: bool = False
    inverted: bool = False

    def first_black(self, rows: int) -> bool:
        """Return whether the square before the first inner corner is black, on a board with `rows` of inner corners."""
        return not self.legacy or rows % 2 == 0

    def places(self, columns: int, rows: int) -> IntArray:
        """Return (column, row) of the square of every marker (M, 2), the one before the first inner corner (0, 0)."""
        row, column = np.mgrid[: rows + 1, : columns + 1]
        return np.argwhere((row + column) % 2 == int(self.first_black(rows)))[:, ::-1]

    def check(self, columns: int, rows: int, squares_mm: tuple[float, float]) -> None:
        if not 0.0 < self.marker_mm < min(squares_mm):
            raise InputError(
                f"markers of {self.marker_mm} mm do not fit into its squares; give the side of a marker with its black "
                "border"
            )

    def ink(self, columns: int, rows: int, squares_mm: tuple[float, float], *, upright: bool = False) -> Ink:
        modules, places = dictionary_modules(self.dictionary), self.places(columns, rows)
        last = self.first_marker + len(places)
        if self.first_marker < 0 or last > len(modules):
            raise InputError(
                f"markers {self.first_marker} to {last - 1} are needed, {self.dictionary} has 0 to {len(modules) - 1}; "
                "take a larger dictionary"
            )
        side = self.marker_mm / (modules.shape[1] + 2)
        gap = 0.5 * (np.array(squares_mm) - self.marker_mm)
        out = []
        for marker, place in enumerate(places, self.first_marker):
            cells = filled_modules(np.pad(modules[marker], 1, constant_values=True), upright=upright) * side
            cells[:, :2] += (place - 1.0) * squares_mm + gap
            out.append(cells)
        return Ink(rectangles=np.concatenate(out), first_black=self.first_black(rows), inverted=self.inverted)

    def describe(self, columns: int, rows: int, squares_mm: tuple[float, float]) -> str:
        plain = Pattern.describe(self, columns, rows, squares_mm)
        old = (", legacy pattern" if self.legacy else "") + (", inverted" if self.inverted else "")
        return f"{plain}, {self.dictionary} from {self.first_marker}, markers {self.marker_mm:g} mm{old}"
