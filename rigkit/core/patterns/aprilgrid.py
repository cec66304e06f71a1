"""AprilGrids: grids of AprilTags, with small black squares between them as in Kalibr, or without."""

from __future__ import annotations

from dataclasses import KW_ONLY, dataclass
from typing import ClassVar

import numpy as np

from rigkit.core.arrays import BoolArray, FloatArray, IntArray
from rigkit.core.errors import InputError
from rigkit.core.patterns.aruco import dictionary_modules
from rigkit.core.patterns.base import Ink, Key, Pattern, filled_modules

TAG_FAMILIES: dict[str, str] = {
    "tag36h11": "DICT_APRILTAG_36h11",
    "tag36h10": "DICT_APRILTAG_36h10",
    "tag25h9": "DICT_APRILTAG_25h9",
    "tag16h5": "DICT_APRILTAG_16h5",
}
"""Names of tag families, and their names in OpenCV."""

NUMBERINGS = ("kalibr", "opencv")
"""Kalibr counts the rows of tags from the bottom, OpenCV's GridBoard from the top; both from the left."""

MAX_SPACING = 2.0
"""Widest gap, in sides of a tag: a larger number is a length."""

MAX_BORDER = 2
"""Widest black border in use, in modules: that of Kalibr; AprilTag and OpenCV use 1."""


@dataclass(frozen=True, slots=True)
class AprilGrid(Pattern):
    """Upright tags in columns and rows. The points are their four corners, so that each tag has two columns and rows.

    Attributes
    ----------
    family : such as "tag36h11", or any dictionary of OpenCV.
    spacing : gap between tags, in sides of a tag.
    border : width of a tag's black border in modules.
    first_tag : number of the first tag; boards in one image need different tags.
    numbering : "kalibr" or "opencv".
    corner_squares : whether small black squares fill the corners between tags.
    inverted : whether black and white are exchanged.
    """

    type: ClassVar[str] = "aprilgrid"
    size_word: ClassVar[str] = "tag"
    size_meaning: ClassVar[str] = "the side of a tag with its black border"
    point_word: ClassVar[str] = "corners of tags"
    count_word: ClassVar[str] = "tags"
    identified: ClassVar[bool] = True
    keys: ClassVar[tuple[Key, ...]] = (
        Key("spacing", "spacing", float, "spacing = 0.3 (from tag to tag, in sides of a tag)", required=True),
        Key("family", "family", str, 'family = "tag36h11"'),
        Key("border", "border", int, "border = 2 (modules of the black border: Kalibr's 2, OpenCV's 1)"),
        Key("first_tag", "first_tag", int, "first_tag = 0"),
        Key("numbering", "numbering", str, 'numbering = "kalibr" (rows from the bottom) or "opencv" (from the top)'),
        Key("corner_squares", "corner_squares", bool, "corner_squares = true (small black squares between the tags)"),
        Key("inverted", "inverted", bool, "inverted = false (true: black and white exchanged)"),
    )

    spacing: float
    family: str = "tag36h11"
    border: int = 2
    first_tag: int = 0
    numbering: str = "kalibr"
    _: KW_ONLY
    corner_squares: bool = True
    inverted: bool = False

    @property
    def points_per_count(self) -> int:
        return 2

    @property
    def dictionary(self) -> str:
        """Name of the family in OpenCV."""
        return TAG_FAMILIES.get(self.family, self.family)

    def check(self, columns: int, rows: int, squares_mm: tuple[float, float]) -> None:
        if columns % 2 or rows % 2:
            raise InputError(f"{columns}x{rows} corners are no whole tags; there must be two columns and rows a tag")
        if not 0.0 < self.spacing <= MAX_SPACING:
            raise InputError(
                f"a spacing of {self.spacing} is not a part of a tag's side; "
                "write the gap over it, such as Kalibr's 0.3"
            )
        if not 1 <= self.border <= MAX_BORDER:
            raise InputError(f"a border of {self.border} modules is unknown; write 2 for Kalibr's tags, 1 for OpenCV's")
        if self.numbering not in NUMBERINGS:
            raise InputError(f"numbering '{self.numbering}' is unknown; known: {', '.join(NUMBERINGS)}")
        if not self.dictionary.startswith("DICT_"):
            raise InputError(
                f"family '{self.family}' is unknown; OpenCV has {', '.join(TAG_FAMILIES)}, and dictionaries such as "
                "DICT_4X4_50"
            )
        count = len(dictionary_modules(self.dictionary))
        last = self.first_tag + columns * rows // 4 - 1
        if self.first_tag < 0 or last >= count:
            raise InputError(f"tags {self.first_tag} to {last} are needed, {self.family} has 0 to {count - 1}")

    @property
    def even_steps(self) -> bool:
        return False

    def positions(self, grid: FloatArray) -> FloatArray:
        # Linear between whole points, so that halves are in the middle of tags and gaps.
        tag, within = np.divmod(np.asarray(grid, dtype=np.float64), 2.0)
        return np.asarray(
            tag * (1.0 + self.spacing) + np.minimum(within, 1.0) + np.maximum(within - 1.0, 0.0) * self.spacing
        )

    def numbers(self, columns: int, rows: int) -> IntArray:
        """Return the number of every tag (rows / 2, columns / 2), the first row on top."""
        own = np.arange(columns * rows // 4).reshape(rows // 2, columns // 2)
        return self.first_tag + (own[::-1] if self.numbering == "kalibr" else own)

    def modules(self) -> BoolArray:
        """Return which modules of the family's tags are black, with the border, in their orientation on the board:
        (N, S, S). OpenCV draws AprilTags rotated by 180 degrees compared with the AprilTag project and Kalibr."""
        own = dictionary_modules(self.dictionary)
        own = own[:, ::-1, ::-1] if self.numbering == "kalibr" else own
        wide = ((0, 0), (self.border, self.border), (self.border, self.border))
        return np.pad(own, wide, constant_values=True)

    def outline(self, columns: int, rows: int) -> tuple[FloatArray, FloatArray]:
        beyond = self.spacing if self.corner_squares else 0.0
        high = self.positions(np.array([[columns - 1, rows - 1]], dtype=np.float64))[0]
        return np.full(2, -beyond), high + beyond

    def ink(self, columns: int, rows: int, squares_mm: tuple[float, float], *, upright: bool = False) -> Ink:
        modules = self.modules()
        side = np.tile(np.array(squares_mm) / modules.shape[1], 2)
        step = np.array(squares_mm) * (1.0 + self.spacing)
        out = []
        for (row, column), number in np.ndenumerate(self.numbers(columns, rows)):
            cells = filled_modules(modules[number], upright=upright) * side
            cells[:, :2] += np.array([column, row]) * step
            out.append(cells)
        if self.corner_squares:
            row, column = np.mgrid[: rows // 2 + 1, : columns // 2 + 1]
            size = self.spacing * np.array(squares_mm)
            place = np.stack([column.ravel(), row.ravel()], axis=-1) * step - size
            out.append(np.concatenate([place, np.tile(size, (len(place), 1))], axis=1))
        return Ink(rectangles=np.concatenate(out), inverted=self.inverted)

    def describe(self, columns: int, rows: int, squares_mm: tuple[float, float]) -> str:
        plain = Pattern.describe(self, columns, rows, squares_mm)
        last = self.first_tag + columns * rows // 4 - 1
        words = f"{plain}, {self.family} {self.first_tag} to {last}, border {self.border}, spacing {self.spacing:g}"
        words += ("" if self.corner_squares else ", no squares between") + f", numbered as {self.numbering}"
        return words + (", inverted" if self.inverted else "")
