"""Chessboards: the corners between their squares are the points."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from rigkit.core.patterns.base import Ink, Pattern


@dataclass(frozen=True, slots=True)
class Chessboard(Pattern):
    """(columns + 1) x (rows + 1) squares; the square before the first inner corner is black."""

    type: ClassVar[str] = "chessboard"

    def turns(self, columns: int, rows: int, even: bool) -> tuple[int, ...]:
        if (columns + rows) % 2 == 1:
            return ()
        return (1, 2, 3) if even and columns == rows and columns % 2 == 0 else (2,)

    def ink(self, columns: int, rows: int, squares_mm: tuple[float, float], *, upright: bool = False) -> Ink:
        return Ink(first_black=True)
