"""Lattices: linked corners in rows and columns.

Grid directions 0, 1, 2, 3 are +column, +row, -column, -row, in the order of the arms of a corner, with the angle
growing from u to v. Every lattice is therefore right-handed (columns, rows, away from the viewer).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import accumulate
from typing import ClassVar

import cv2
import numpy as np

from rigkit.core.arrays import BoolArray, FloatArray, IntArray
from rigkit.detection.lattice.links import Links
from rigkit.detection.saddles.saddle import Corners
from rigkit.kernels.growth import components_of

MIN_ROWS = 3
"""Rows and columns of the smallest board: smaller lattices are often something else."""

MANY_CORNERS = 200
"""Lattices with so many corners are first tested by a sample."""

BLOCKS = ((3, 3, 1), (2, 4, 0), (4, 2, 0))
"""Rows, columns and missing corners of the smallest blocks that indicate a board: squares of random brightness that
happen to alternate form crooked chains."""


@dataclass(frozen=True, eq=False)
class Lattice:
    """Corners of one board, or of a part of it; immutable, so that properties are cached.

    Attributes
    ----------
    pixels : (R, C, 2) full resolution, NaN where no corner is known.
    contrast : (R, C) grey levels, NaN likewise.
    rising : whether brightness increases with the angle across the +column edge of corner (0, 0); it alternates over
        the lattice like the squares.
    """

    pixels: FloatArray
    contrast: FloatArray
    rising: bool

    @cached_property
    def known(self) -> BoolArray:
        return np.isfinite(self.pixels[..., 0])

    @cached_property
    def count(self) -> int:
        return int(np.count_nonzero(self.known))

    @cached_property
    def solid(self) -> bool:
        """Whether it contains one of BLOCKS."""
        if self.count == self.known.size and min(self.size) >= 3:
            return True
        known = self.known.astype(np.uint8)
        return any(
            cv2.boxFilter(known, -1, (columns, rows), normalize=False, borderType=cv2.BORDER_CONSTANT).max(initial=0)
            >= rows * columns - missing
            for rows, columns, missing in BLOCKS
        )

    @property
    def size(self) -> tuple[int, int]:
        """(columns, rows)."""
        return (self.pixels.shape[1], self.pixels.shape[0])

    def signs(self) -> FloatArray:
        """Return (R, C): +1 where brightness increases with the angle across the +column edge, else -1."""
        signs = np.full(self.pixels.shape[:2], self.sign_at(0, 0))
        signs[1::2, ::2] *= -1.0
        signs[::2, 1::2] *= -1.0
        return signs

    def sign_at(self, row: int, column: int) -> float:
        """Return +1 if brightness increases with the angle across the +column edge of a corner, else -1."""
        return 1.0 if self.rising != ((row + column) % 2 == 1) else -1.0

    def padded(self, rows: tuple[int, int], columns: tuple[int, int]) -> Lattice:
        """Return the lattice with numbers of empty rows and columns added before and after."""
        odd = (rows[0] + columns[0]) % 2 == 1
        return Lattice(padded(self.pixels, rows, columns), padded(self.contrast, rows, columns), self.rising != odd)

    def filled(self, other: Lattice) -> Lattice:
        """Return the lattice with missing corners taken from `other`, of the same size."""
        known = self.known
        return Lattice(
            np.where(known[..., None], self.pixels, other.pixels),
            np.where(known, self.contrast, other.contrast),
            self.rising,
        )

    def cut(self, rows: slice, columns: slice) -> Lattice:
        """Return the part of `rows` and `columns` (slices with a start and without a step)."""
        odd = ((rows.start or 0) + (columns.start or 0)) % 2 == 1
        return Lattice(self.pixels[rows, columns], self.contrast[rows, columns], self.rising != odd)

    def without(self, drop: BoolArray) -> Lattice:
        """Return the lattice without the corners `drop` (R, C)."""
        pixels = np.where(drop[..., None], np.nan, self.pixels)
        return Lattice(pixels, np.where(drop, np.nan, self.contrast), self.rising)

    @property
    def extent(self) -> tuple[slice, slice]:
        """Rows and columns from the first to the last that is not empty."""
        known = self.known
        rows, columns = (np.asarray(known.any(axis=axis)) for axis in (1, 0))
        if not rows.any():
            return slice(0, 0), slice(0, 0)
        top, bottom = int(rows.argmax()), len(rows) - int(rows[::-1].argmax())
        left, right = int(columns.argmax()), len(columns) - int(columns[::-1].argmax())
        return slice(top, bottom), slice(left, right)

    def trimmed(self) -> Lattice:
        """Return the lattice without empty outer rows and columns."""
        return self.cut(*self.extent)

    def turned(self, quarter_turns: int) -> Lattice:
        """Return the same corners with the first corner moved by `quarter_turns` x 90 degrees (still right-handed).

        As `BoardDetection.turned`: one turn makes (column, row) into (rows - 1 - row, column).
        """
        out = self
        for _ in range(quarter_turns % 4):
            first = out.sign_at(len(out.contrast) - 1, 0)
            out = Lattice(turned(out.pixels, 1), turned(out.contrast, 1), bool(out.contrast.size and first < 0.0))
        return out


def turned(values: FloatArray, quarter_turns: int) -> FloatArray:
    """Return `values` (R, C, ...) of the corners of a lattice as for `Lattice.turned`, ten times as fast as
    np.rot90."""
    for _ in range(quarter_turns % 4):
        values = values.swapaxes(0, 1)[:, ::-1]
    return values


def padded(values: FloatArray, rows: tuple[int, int], columns: tuple[int, int]) -> FloatArray:
    """Return `values` (R, C, ...) with numbers of rows and columns of NaN added before and after."""
    height, width = values.shape[:2]
    out = np.full((rows[0] + height + rows[1], columns[0] + width + columns[1], *values.shape[2:]), np.nan)
    out[rows[0] : rows[0] + height, columns[0] : columns[0] + width] = values
    return out


Margins = tuple[tuple[int, int], tuple[int, int]]


def margins(one: tuple[int, int], two: tuple[int, int], shift: IntArray) -> tuple[Margins, Margins]:
    """Return the padding of two lattices of sizes `one` and `two`, the second shifted by `shift` (columns, rows)."""
    low = np.minimum(0, shift)
    size = np.maximum(one, shift + np.array(two)) - low
    first, second = (
        np.stack([at, size - at - mine], axis=-1)[::-1].tolist() for at, mine in ((-low, one), (shift - low, two))
    )
    return (tuple(first[0]), tuple(first[1])), (tuple(second[0]), tuple(second[1]))


@dataclass(frozen=True, eq=False, slots=True)
class LatticeStack:
    """Several lattices one below the other in common arrays, with GAP empty rows between, to be processed at once.

    Attributes
    ----------
    pixels : (R, C, 2), contrast : (R, C), NaN where unknown; signs : (R, C) as `Lattice.signs`, 0 outside.
    parts : rows and columns of each lattice.
    """

    GAP: ClassVar[int] = 4

    pixels: FloatArray
    contrast: FloatArray
    signs: FloatArray
    parts: tuple[tuple[slice, slice], ...]

    @classmethod
    def of(cls, lattices: Sequence[Lattice]) -> LatticeStack:
        tops = list(accumulate((item.pixels.shape[0] + cls.GAP for item in lattices), initial=0))
        columns = max((item.pixels.shape[1] for item in lattices), default=0)
        pixels = np.full((tops[-1], columns, 2), np.nan)
        contrast, signs = np.full(pixels.shape[:2], np.nan), np.zeros(pixels.shape[:2])
        parts = []
        for top, item in zip(tops, lattices, strict=False):
            part = (slice(top, top + item.pixels.shape[0]), slice(0, item.pixels.shape[1]))
            pixels[part], contrast[part], signs[part] = item.pixels, item.contrast, item.signs()
            parts.append(part)
        return cls(pixels, contrast, signs, tuple(parts))


def build_lattices(corners: Corners, links: Links) -> Iterator[Lattice]:
    """Yield the lattices formed by closed squares of four linked corners, the largest first."""
    count, label, grid, turn, members = components_of(links.state)
    sizes = np.bincount(label[label >= 0], minlength=count)
    ends = np.cumsum(sizes)
    for k in np.argsort(-sizes, kind="stable"):
        mine = members[ends[k] - sizes[k] : ends[k]]
        whole = _lattice(corners, mine, grid[mine], int(turn[mine[0]]))
        if whole is not None:
            yield whole


def _lattice(corners: Corners, mine: IntArray, cells: IntArray, turn: int) -> Lattice | None:
    """Return the lattice of the corners `mine` (N,) in the `cells` (N, 2), without corners in the same cell.

    `turn` is the arm of the first corner that points to +column. None if fewer than four corners remain.
    """
    cells = cells - cells.min(axis=0)
    columns, rows = (int(last) + 1 for last in cells.max(axis=0))
    flat = cells[:, 1] * columns + cells[:, 0]
    single = np.bincount(flat)[flat] == 1
    if np.count_nonzero(single) < 4:
        return None
    pixels = np.full((rows * columns, 2), np.nan)
    contrast = np.full(rows * columns, np.nan)
    pixels[flat[single]] = corners.pixels[mine[single]]
    contrast[flat[single]] = corners.contrast[mine[single]]
    rising = (turn + int(cells[0].sum())) % 2 == 0
    whole = Lattice(pixels.reshape(rows, columns, 2), contrast.reshape(rows, columns), rising)
    return whole if single.all() else whole.trimmed()
