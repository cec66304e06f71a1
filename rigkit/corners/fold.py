"""Where one lattice is really several boards, and where several lattices are really one board.

Boards whose squares meet at a seam grow together into one lattice that folds there: it is cut. A ruler across a board
cuts its lattice in two that continue each other: they are joined.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations

import cv2
import numpy as np

from rigkit.arrays import FloatArray, IntArray
from rigkit.corners.lattice import Lattice
from rigkit.corners.local_fit import fit_cells

__all__ = ["join_parts", "split_folds"]

FOLD = 0.16
FOLD_FACTOR = 3.5
"""A lattice folds at a row or column where neighbouring steps differ by more than this (relative to the step), and by
more than this factor times what is typical of it: perspective and fisheyes bend everywhere, a seam bends once."""

LEAST_FOR_FOLD = 5
"""Columns or rows needed to say what is typical."""

LEAST_ROWS = 4
"""Rows that must fold at a column."""

CONTINUES_CELLS = 0.1
"""A column that goes on smoothly lies this near to where the others say, in cells."""

GAP = 2
"""Parts of one board are at most so many steps apart: separate boards have their outer squares and margins between."""

NEAREST_IN, NEAREST_OUT = 16, 6
"""Corners of the one part that carry its rows over, and of the other that must meet them."""

MEETS_CELLS = 0.15


def split_folds(lattice: Lattice) -> list[Lattice]:
    """Return the parts of `lattice` between its folds; the corners on a fold belong to no board."""
    for turned in (False, True):
        upright = lattice.turned(1) if turned else lattice
        at = _fold(upright.pixels)
        if at is not None:
            left, right = _halves(upright, at)
            parts = split_folds(left) + split_folds(right)
            return [part.turned(3) for part in parts] if turned else parts
    return [lattice]


def _halves(lattice: Lattice, at: int) -> tuple[Lattice, Lattice]:
    """Return what lies on either side of the column `at`, which goes with the one side whose rows it continues.

    A column on the seam itself continues both, and is dropped.
    """
    columns, rows = lattice.size
    every = slice(0, rows)
    continues = [_continues(lattice, part, at) for part in (slice(0, at), slice(at + 1, columns))]
    left = at + 1 if continues == [True, False] else at
    right = at if continues == [False, True] else at + 1
    return lattice.cut(every, slice(0, left)), lattice.cut(every, slice(right, columns))


def _continues(lattice: Lattice, part: slice, at: int) -> bool:
    """Return whether the corners of column `at` are where the columns `part` say."""
    pixels = np.full(lattice.pixels.shape, np.nan)
    pixels[:, part] = lattice.pixels[:, part]
    cells = np.zeros(lattice.known.shape, bool)
    cells[:, at] = lattice.known[:, at]
    shape = fit_cells(pixels, cells, degree=2, ridge=(0.02, 1.0))
    side = np.minimum(np.linalg.norm(shape.along_column, axis=1), np.linalg.norm(shape.along_row, axis=1))
    off = np.linalg.norm(shape.pixels - lattice.pixels[cells], axis=1)
    return bool(np.median(off / np.maximum(side, 1e-9)) < CONTINUES_CELLS)


def _fold(pixels: FloatArray) -> int | None:
    """Return the column of `pixels` (R, C, 2) at which the rows fold, None if they do not."""
    columns = pixels.shape[1]
    if columns < LEAST_FOR_FOLD:
        return None
    step = np.diff(pixels, axis=1)
    change = np.linalg.norm(np.diff(step, axis=1), axis=2)
    length = np.linalg.norm(step, axis=2)
    relative = change / np.minimum(length[:, 1:], length[:, :-1])
    seen = np.isfinite(relative)
    enough = seen.sum(axis=0) >= max(LEAST_ROWS, 0.4 * len(pixels))
    if enough.sum() < LEAST_FOR_FOLD - 2:
        return None
    typical = np.array([np.median(relative[seen[:, j], j]) if enough[j] else np.nan for j in range(columns - 2)])
    at = int(np.nanargmax(typical))
    others = np.delete(typical, at)
    folds = typical[at] > max(FOLD, FOLD_FACTOR * float(np.nanmedian(others)))
    return at + 1 if folds else None


def join_parts(lattices: Sequence[Lattice]) -> list[Lattice]:
    """Return `lattices` with those joined that continue each other's rows and columns across a short gap."""
    parts = sorted((item for item in lattices if item.count >= 6), key=lambda item: -item.count)
    done = False
    while not done:
        done = True
        for i, j in combinations(range(len(parts)), 2):
            joined = _joined(parts[i], parts[j]) if _near(parts[i], parts[j]) else None
            if joined is not None:
                parts = [joined, *(item for k, item in enumerate(parts) if k not in (i, j))]
                done = False
                break
    return parts


def _near(one: Lattice, two: Lattice) -> bool:
    """Return whether the lattices' bounding boxes come within GAP sides of a cell, at its largest."""
    boxes = [(np.nanmin(item.pixels, axis=(0, 1)), np.nanmax(item.pixels, axis=(0, 1))) for item in (one, two)]
    reach = GAP * float(np.nanmax(np.abs(np.diff(one.pixels, axis=1)), initial=0.0))
    reach = max(reach, GAP * float(np.nanmax(np.abs(np.diff(one.pixels, axis=0)), initial=0.0)))
    return bool((np.maximum(boxes[0][0], boxes[1][0]) - np.minimum(boxes[0][1], boxes[1][1])).max() < reach)


def _joined(one: Lattice, two: Lattice) -> Lattice | None:
    """Return both lattices in one, None if `two` does not continue `one`."""
    grid1, grid2 = (np.argwhere(item.known)[:, ::-1] for item in (one, two))
    pixels1, pixels2 = one.pixels[one.known], two.pixels[two.known]
    apart = np.linalg.norm(pixels1[:, None] - pixels2, axis=2)
    near2 = np.argsort(apart.min(axis=0), kind="stable")[:NEAREST_OUT]
    near1 = np.argsort(apart[:, near2].min(axis=1), kind="stable")[:NEAREST_IN]
    side = np.linalg.norm(np.diff(one.pixels, axis=1), axis=2)
    if not apart.min() < 2.0 * GAP * float(np.nanmax(side, initial=0.0)) or len(np.unique(grid1[near1, 0])) < 2:
        return None
    grid_from_pixel, _ = cv2.findHomography(pixels1[near1], grid1[near1].astype(np.float64), 0)
    if grid_from_pixel is None:
        return None
    place = cv2.perspectiveTransform(pixels2[near2][None], grid_from_pixel)[0]
    whole = np.rint(place)
    if not np.abs(place - whole).max() < MEETS_CELLS:
        return None
    for quarter in range(4):
        turned = two.turned(quarter)
        local = _turned_grid(grid2[near2], two.size, quarter)
        shift = whole.astype(np.int64) - local
        if (shift == shift[0]).all():
            return _united(one, turned, shift[0])
    return None


def _turned_grid(grid: IntArray, size: tuple[int, int], quarter_turns: int) -> IntArray:
    columns, rows = size
    for _ in range(quarter_turns):
        grid = np.stack([rows - 1 - grid[:, 1], grid[:, 0]], axis=1)
        columns, rows = rows, columns
    return grid


def _united(one: Lattice, two: Lattice, shift: IntArray) -> Lattice | None:
    """Return `two`, moved by `shift` (columns, rows), put into `one`; None if they overlap, differ or are far apart."""
    low = np.minimum(0, shift)
    high = np.maximum(one.size, shift + np.array(two.size))
    columns, rows = high - low
    parts = []
    for item, at in ((one, -low), (two, shift - low)):
        pixels = np.full((rows, columns, 2), np.nan)
        contrast = np.full((rows, columns), np.nan)
        signs = np.zeros((rows, columns))
        place = (slice(at[1], at[1] + item.size[1]), slice(at[0], at[0] + item.size[0]))
        pixels[place], contrast[place], signs[place] = item.pixels, item.contrast, item.signs()
        odd = (np.arange(rows)[:, None] + np.arange(columns)) % 2
        rising = bool((signs * np.where(odd == 1, -1.0, 1.0))[place].flat[0] > 0.0)
        parts.append(Lattice(pixels, contrast, rising))
    first, second = parts
    if first.rising != second.rising or (first.known & second.known).any():
        return None
    reach = cv2.dilate(first.known.astype(np.uint8), np.ones((2 * GAP + 1, 2 * GAP + 1), np.uint8)) > 0
    if not (reach & second.known).any():
        return None
    known = first.known
    return Lattice(
        np.where(known[..., None], first.pixels, second.pixels),
        np.where(known, first.contrast, second.contrast),
        first.rising,
    )
