"""Splitting lattices that contain several boards, and joining lattices that are parts of one board.

Boards whose squares touch grow into one lattice with a discontinuity, where it is split. An object across a board cuts
its lattice into parts that continue each other, which are joined.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np

from rigkit.core.arrays import BoolArray, FloatArray, IntArray, median_of
from rigkit.core.detections import grid_turned
from rigkit.detection.lattice.lattice import Lattice, margins
from rigkit.detection.lattice.local_fit import FLEXIBLE, MIN_PREDICTING, PREDICTION_WIDTH, STIFF, fit_cells
from rigkit.detection.lattice.spacing import SpacingChange, spacing_changes

MIN_TURN = 0.16
TURN_FACTOR = 3.5
"""A lattice is split at a row or column where successive steps differ by more than MIN_TURN (relative to the step) and
TURN_FACTOR times their typical difference: perspective and fisheyes bend rows everywhere, a discontinuity at one
place."""

MIN_FOR_TYPICAL = 5
"""Smallest number of columns or rows for a typical difference."""

MIN_TURNED_ROWS = 4
"""Smallest number of rows with a difference at a column."""

CONTINUES_CELLS = 0.1
"""Largest median distance, in cells, between a column and its prediction by the columns that it continues."""

GAP, SLANTED = 2, 3
"""Largest gap between parts of one board, in steps along a row or column, or along both for SLANTED corners or more:
separate boards have outer squares and margins between them, or touch at a corner."""

FAR_GAP, FAR_MEETS_CELLS, FAR_OUT, FAR_FACING = 3, 0.1, 24, 2
"""A larger gap is allowed if the nearest FAR_OUT corners of the other part agree with their predictions within
FAR_MEETS_CELLS, and FAR_FACING of them have a corner of the first part along their row or column."""

JOIN_REACH = 3.3
"""Upper bound of the distance between the nearest corners across the larger gap, in sides."""

NEAREST_IN, NEAREST_OUT = 16, 6
"""Corners of one part that extrapolate its grid, and of the other part that must agree."""

MEETS_CELLS, MEETS_AT_ALL = 0.15, 0.42
"""Largest distances, in cells, between corners of the other part and their predictions by a homography of the first. Up
to the smaller one the parts agree; up to the larger one, due to lens distortion, `_agree` decides."""

AGREES_CELLS, BETWEEN = 0.12, 8
"""Largest median distance, in cells, between the predictions by two parts of the cells between them, and the number of
such cells: those with the smallest standard deviations."""

LOOSE_CELLS, MAX_HELD_GAIN = 0.08, 8.0
"""Largest distance of a loose corner from its prediction by a lattice, in cells and for the standard deviation of a
corner, and largest standard deviation of the prediction over that of a corner."""


def split_at_turns(lattice: Lattice) -> list[Lattice]:
    """Return the parts of `lattice` between its discontinuities; corners on a discontinuity are dropped."""
    columns, rows = lattice.size
    along_rows, along_columns = spacing_changes(lattice.pixels)
    at = _sharpest_turn(rows, along_rows)
    if at is not None:
        return [part for half in _halves(lattice, at) for part in split_at_turns(half)]
    at = _sharpest_turn(columns, along_columns)
    if at is not None:
        # After a quarter turn the row is a column, numbered from the other end.
        halves = _halves(lattice.turned(1), rows - 1 - at)
        return [part.turned(3) for half in halves for part in split_at_turns(half)]
    return [lattice]


def _halves(lattice: Lattice, at: int) -> tuple[Lattice, Lattice]:
    """Return the parts on either side of column `at`, which belongs to the part whose rows it continues.

    If it continues both or none, it is dropped.
    """
    columns, rows = lattice.size
    every = slice(0, rows)
    continues = [_continues(lattice, part, at) for part in (slice(0, at), slice(at + 1, columns))]
    left = at + 1 if continues == [True, False] else at
    right = at if continues == [False, True] else at + 1
    return lattice.cut(every, slice(0, left)), lattice.cut(every, slice(right, columns))


def _continues(lattice: Lattice, part: slice, at: int) -> bool:
    """Return whether the corners of column `at` agree with their predictions by the columns `part`."""
    pixels = np.full(lattice.pixels.shape, np.nan)
    pixels[:, part] = lattice.pixels[:, part]
    cells = np.zeros(lattice.known.shape, bool)
    cells[:, at] = lattice.known[:, at]
    shape = fit_cells(pixels, cells, **STIFF._asdict())
    side = shape.shorter_px()
    off = np.linalg.norm(shape.pixels - lattice.pixels[cells], axis=1)
    return bool(np.median(off / np.maximum(side, 1e-9)) < CONTINUES_CELLS)


def split_necks(lattice: Lattice) -> list[Lattice]:
    """Return the boards in `lattice`, without corners that contradict the others.

    Boards that touch at an angle are connected by a few wrong corners. The broad parts of a lattice, blocks of 3 x 3
    corners, are therefore kept together only if they continue each other; other corners are added to the part that
    predicts them.
    """
    known = lattice.known
    if known.all() and min(known.shape) >= 2:
        return [lattice]
    groups: list[BoolArray] = []
    for broad in _broad_parts(known):
        # Usually there is only one.
        part = _LatticePart.of(lattice.without(~broad)) if groups else None
        for number, group in enumerate(groups):
            if part is not None and _same_board(_LatticePart.of(lattice.without(~group)), part):
                groups[number] = group | broad
                break
        else:
            groups.append(broad)
    _absorb(lattice, groups)
    return [lattice.without(~group).trimmed() for group in groups]


def _broad_parts(known: BoolArray) -> list[BoolArray]:
    """Return the parts of `known` (R, C) covered by blocks of 3 x 3 corners (or else 2 x 2), the largest first."""
    for side in (3, 2):
        square = np.ones((side, side), np.uint8)
        fits = cv2.erode(known.astype(np.uint8), square, anchor=(0, 0), borderType=cv2.BORDER_CONSTANT, borderValue=0)
        squares = cv2.dilate(fits, square, anchor=(side - 1, side - 1))
        count, label, stats, _ = cv2.connectedComponentsWithStats(squares, connectivity=4)
        if count > 1:
            order = 1 + np.argsort(-stats[1:, cv2.CC_STAT_AREA], kind="stable")
            return [label == number for number in order]
    return []


def _same_board(one: _LatticePart, two: _LatticePart) -> bool:
    """Return whether two parts of one lattice continue each other."""
    near, place = _carried_over(one, two, _squared_gaps(one, two))
    off = float(np.abs(place - two.grid[near])[:NEAREST_OUT].max())
    if not MEETS_CELLS <= off < MEETS_AT_ALL:
        return off < MEETS_CELLS
    pixels = np.where(one.lattice.known[..., None], one.lattice.pixels, two.lattice.pixels)
    return _agree(pixels, one.lattice.known, two.lattice.known)


def _absorb(lattice: Lattice, groups: list[BoolArray]) -> None:
    """Add the other corners of `lattice`, ring by ring, to the `groups` (IN PLACE) that predict them."""
    loose = lattice.known & ~np.any(groups, axis=0) if groups else np.zeros_like(lattice.known)
    while loose.any():
        off = np.full((len(groups), *loose.shape), np.inf)
        for number, group in enumerate(groups):
            fit = fit_cells(lattice.without(~group).pixels, loose, width=PREDICTION_WIDTH, **STIFF._asdict())
            side = np.minimum(np.hypot(*fit.along_column.T), np.hypot(*fit.along_row.T))
            distance = np.hypot(*(fit.pixels - lattice.pixels[loose]).T)
            with np.errstate(divide="ignore", invalid="ignore"):
                cells = distance / (side * np.hypot(1.0, fit.gain))
            off[number][loose] = np.where((fit.support >= MIN_PREDICTING) & (fit.gain < MAX_HELD_GAIN), cells, np.inf)
        best = off.argmin(axis=0)
        added = loose & (off.min(axis=0) < LOOSE_CELLS)
        if not added.any():
            break
        for number, group in enumerate(groups):
            groups[number] = group | (added & (best == number))
        loose &= ~added


def _sharpest_turn(rows: int, uneven: SpacingChange) -> int | None:
    """Return the column with the largest difference of steps if it is a discontinuity of most of the `rows`, else
    None."""
    least = max(MIN_TURNED_ROWS, 0.4 * rows)
    steps = enumerate(zip(uneven.typical, uneven.seen, strict=True), start=1)
    measured = [(bend, -column) for column, (bend, count) in steps if count >= least]
    if len(measured) < MIN_FOR_TYPICAL - 2:
        return None
    *others, (sharpest, column) = sorted(measured)
    middle = 0.5 * (others[(len(others) - 1) // 2][0] + others[len(others) // 2][0])
    return -column if sharpest > max(MIN_TURN, TURN_FACTOR * middle) else None


def join_parts(lattices: Sequence[Lattice]) -> list[Lattice]:
    """Return `lattices`, joining those that continue each other's rows and columns across a short gap."""
    ordered = [item for item in sorted(lattices, key=lambda item: -item.count) if item.count >= 6]
    if len(ordered) < 2:
        return ordered
    parts = [_LatticePart.of(item) for item in ordered]
    done = False
    while not done:
        done = True
        for i, j in _near(parts):
            joined = _joined(parts[i], parts[j])
            if joined is not None:
                parts = [_LatticePart.of(joined), *(item for k, item in enumerate(parts) if k not in (i, j))]
                done = False
                break
    return [part.lattice for part in parts]


@dataclass(frozen=True, eq=False)
class _LatticePart:
    """A lattice with its corners (N, 2), their (column, row), bounding box, and longest side of a cell."""

    lattice: Lattice
    pixels: FloatArray
    grid: IntArray
    low: FloatArray
    high: FloatArray
    side_px: float

    @classmethod
    def of(cls, lattice: Lattice) -> _LatticePart:
        row, column = np.nonzero(lattice.known)
        pixels = lattice.pixels[row, column]
        steps = (lattice.pixels[:, 1:] - lattice.pixels[:, :-1], lattice.pixels[1:] - lattice.pixels[:-1])
        longest = (np.fmax.reduce(s[..., 0] ** 2 + s[..., 1] ** 2, axis=None, initial=0.0) for s in steps)
        side = math.sqrt(max(longest))
        grid = np.stack([column, row], axis=-1)
        return cls(lattice, pixels, grid, pixels.min(axis=0), pixels.max(axis=0), side)

    @cached_property
    def cells(self) -> FloatArray:
        """(N, 2, 2) sides of the cells at the corners."""
        return fit_cells(self.lattice.pixels, self.lattice.known, degree=1).sides


def _near(parts: Sequence[_LatticePart]) -> list[tuple[int, int]]:
    """Return the pairs whose bounding boxes are within FAR_GAP of the longest sides of the first part's cells."""
    if len(parts) < 2:
        return []
    low, high = np.array([item.low for item in parts]), np.array([item.high for item in parts])
    gap = (np.maximum(low[:, None], low) - np.minimum(high[:, None], high)).max(axis=2)
    near = np.triu(gap < FAR_GAP * np.array([[item.side_px] for item in parts]), 1)
    return [(int(i), int(j)) for i, j in np.argwhere(near)]


def _joined(one: _LatticePart, two: _LatticePart) -> Lattice | None:
    """Return both lattices joined, None if `two` does not continue `one`."""
    squared = _squared_gaps(one, two)
    nearest = divmod(int(squared.argmin()), len(two.pixels))
    longest = max(math.hypot(*side) for side in one.cells[nearest[0]].tolist())
    if not math.sqrt(squared[nearest]) < JOIN_REACH * longest:
        return None
    near, place = _carried_over(one, two, squared)
    whole = np.rint(place)
    with np.errstate(invalid="ignore"):
        away = np.abs(place - whole).max(axis=1)
    far_off, off = float(away.max()), float(away[:NEAREST_OUT].max())
    near, whole = near[:NEAREST_OUT], whole[:NEAREST_OUT]
    if not off < MEETS_AT_ALL:
        return None
    for quarter in range(4):
        shift = whole.astype(np.int64) - grid_turned(two.grid[near], two.lattice.size, quarter)
        if (shift == shift[0]).all():
            far = far_off < FAR_MEETS_CELLS
            united = _united(one.lattice, two.lattice.turned(quarter), shift[0], far)
            if united is None or off < MEETS_CELLS:
                return united
            left, top = np.maximum(0, -shift[0])
            mine = np.zeros(united.known.shape, bool)
            mine[top : top + one.lattice.size[1], left : left + one.lattice.size[0]] = one.lattice.known
            return united if _agree(united.pixels, mine, united.known & ~mine) else None
    return None


def _agree(pixels: FloatArray, one: BoolArray, two: BoolArray) -> bool:
    """Return whether two parts of the corners `pixels` (R, C, 2) predict the same positions of the cells between them.

    Smooth surfaces extrapolate each part for any lens: the stiffer one tolerates partly covered corners, the more
    flexible one follows strongly bent rows.
    """
    reach = np.ones((2 * GAP + 1, 2 * GAP + 1), np.uint8)
    between = (cv2.dilate(one.astype(np.uint8), reach) > 0) & (cv2.dilate(two.astype(np.uint8), reach) > 0)
    for how in (STIFF, FLEXIBLE):
        mine, theirs = (
            fit_cells(np.where(part[..., None], pixels, np.nan), between, width=PREDICTION_WIDTH, **how._asdict())
            for part in (one, two)
        )
        supported = np.minimum(mine.support, theirs.support) > MIN_PREDICTING
        gain = np.where(supported, np.maximum(mine.gain, theirs.gain), np.inf)
        best = np.argsort(gain)[: min(BETWEEN, int(np.isfinite(gain).sum()))]
        side = np.minimum(np.hypot(*mine.along_column[best].T), np.hypot(*mine.along_row[best].T))
        separation = np.hypot(*(mine.pixels - theirs.pixels)[best].T) / np.maximum(side, 1e-9)
        if len(best) and median_of(separation) < AGREES_CELLS:
            return True
    return False


def _squared_gaps(one: _LatticePart, two: _LatticePart) -> FloatArray:
    """Return the squared distances between the corners, (N, M)."""
    across, down = (one.pixels[:, k, None] - two.pixels[:, k] for k in (0, 1))
    across *= across
    down *= down
    across += down
    return across


def _carried_over(one: _LatticePart, two: _LatticePart, squared: FloatArray) -> tuple[IntArray, FloatArray]:
    """Return the FAR_OUT nearest corners of `two` and their (column, row) extrapolated from `one`; infinity if
    impossible.

    `squared` (N, M) are the `_squared_gaps`.
    """
    near2 = np.argsort(squared.min(axis=0), kind="stable")[:FAR_OUT]
    near1 = np.argsort(squared[:, near2[:NEAREST_OUT]].min(axis=1), kind="stable")[:NEAREST_IN]
    if (one.grid[near1] == one.grid[near1[0]]).all(axis=0).any():
        return near2, np.full((len(near2), 2), np.inf)
    return near2, _extrapolated(one.pixels[near1], one.grid[near1], two.pixels[near2])


def _extrapolated(pixels: FloatArray, grid: IntArray, there: FloatArray) -> FloatArray:
    """Return the (column, row) at the pixels `there` (M, 2) by a homography through corners at `pixels` (N, 2) with
    `grid` (N, 2), NaN if it is not determined.

    Least squares of the equations linear in its coefficients, near the corners those of the distances in the grid.
    """
    middle, scale = pixels.mean(axis=0), max(float(np.abs(pixels - pixels[0]).max()), 1e-9)
    origin = grid.mean(axis=0)
    places, cells = (pixels - middle) / scale, grid - origin
    rows = np.zeros((2, len(places), 8))
    rows[0, :, 0:2] = rows[1, :, 3:5] = places
    rows[0, :, 2] = rows[1, :, 5] = 1.0
    rows[..., 6:] = -cells.T[..., None] * places
    equations = rows.reshape(-1, 8)
    try:
        a = np.linalg.solve(equations.T @ equations, equations.T @ cells.T.reshape(-1))
    except np.linalg.LinAlgError:
        return np.full((len(there), 2), np.nan)
    at = (there - middle) / scale
    along = np.stack([at @ a[0:2] + a[2], at @ a[3:5] + a[5]], axis=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(along / (1.0 + at @ a[6:])[:, None] + origin)


def _facing(one: Lattice, two: Lattice, steps: int, shape: int = cv2.MORPH_CROSS) -> int:
    """Return how many corners of `two` have a corner of `one` within `steps` along row or column (or both)."""
    reach = cv2.getStructuringElement(shape, (2 * steps + 1, 2 * steps + 1))
    return int(np.count_nonzero((cv2.dilate(one.known.astype(np.uint8), reach) > 0) & two.known))


def _united(one: Lattice, two: Lattice, shift: IntArray, far: bool) -> Lattice | None:
    """Return `one` joined with `two` shifted by `shift` (columns, rows).

    None if they overlap, have different colours, or have a too large gap.
    """
    first, second = (item.padded(*m) for item, m in zip((one, two), margins(one.size, two.size, shift), strict=True))
    if first.rising != second.rising or (first.known & second.known).any():
        return None
    close = _facing(first, second, GAP) or _facing(first, second, GAP, cv2.MORPH_RECT) >= SLANTED
    across_gap = far and _facing(first, second, FAR_GAP) >= FAR_FACING
    return first.filled(second) if close or across_gap else None
