"""Growing a lattice ring by ring: fills holes, reaches the edges of the board, and never jumps to another board.

Each empty cell next to known corners is predicted from its neighbourhood; a saddle near the prediction is taken if it
is a corner with the polarity and the directions that the lattice demands and if the edges to its neighbours are seen.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from rigkit.arrays import BoolArray, FloatArray, IntArray
from rigkit.corners.lattice import STEPS, Lattice, Sheet
from rigkit.corners.links import CONTRAST_RATIO, MOST, edge_contrast
from rigkit.corners.local_fit import LocalFit, fit_cells
from rigkit.corners.response import Level
from rigkit.corners.ring import read_rings
from rigkit.corners.saddle import Saddles

__all__ = ["SaddleIndex", "grow", "grow_all"]

MAX_RINGS = 60
"""More rings than any board has rows or columns."""

STIFF = (2, (0.02, 1.0))
PLIANT = (3, (1e-3, 1e-2))
"""Degree and ridge of the prediction: one is steady with few neighbours, the other follows the rim of a fisheye."""

BATCH, MAX_BATCHES = 16, 6
"""So many lattices grow at a time, so many times: clutter makes hundreds of seeds, most of them of one square."""

REACH = 0.25
"""A corner lies within this of its prediction, in cells."""

TRIED = 6
"""Saddles tried for a cell."""

RING = 0.3
"""Radius of the ring in heights of the cell: well inside the four squares."""

MIN_RING_PX, MAX_RING_PX = 2.2, 9.0

LINE_SINE = np.sin(np.radians(25.0))
"""How well the ring's lines must follow the lattice."""


class SaddleIndex:
    """All saddles of an image, ready to be asked for the nearest."""

    def __init__(self, saddles: Saddles) -> None:
        from scipy.spatial import cKDTree

        self.pixels = saddles.pixels
        self._tree = cKDTree(saddles.pixels) if len(saddles.pixels) else None

    def nearest(self, pixels: FloatArray, reach_px: FloatArray) -> tuple[IntArray, BoolArray]:
        """Return the TRIED nearest saddles of each of `pixels` (M, 2) and which of them lie within `reach_px` (M,)."""
        if self._tree is None or not len(pixels):
            return np.zeros((len(pixels), TRIED), np.int64), np.zeros((len(pixels), TRIED), bool)
        distance, index = self._tree.query(pixels, k=TRIED)
        found = distance <= reach_px[:, None]
        return np.where(found, index, 0), found


def grow_all(lattices: Sequence[Lattice], saddles: SaddleIndex, level: Level) -> list[Lattice]:
    """Return the lattices grown from `lattices`, the largest first; those that others have grown over are left out."""
    pending = sorted(lattices, key=lambda item: -item.count)
    grown: list[Lattice] = []
    for _ in range(MAX_BATCHES):
        if not pending:
            break
        fresh = grow(pending[:BATCH], saddles, level)
        grown += fresh
        corners = np.concatenate([item.pixels[item.known] for item in fresh])
        pending = [item for item in pending[BATCH:] if not _covered(item, corners)]
    return grown


def _covered(lattice: Lattice, corners: FloatArray) -> bool:
    """Return whether most of the corners of `lattice` are among `corners` (M, 2)."""
    gaps = lattice.pixels[lattice.known][:, None] - corners
    return bool(((np.abs(gaps).max(axis=2) < 1.0).any(axis=1)).mean() > 0.5)


def grow(lattices: Sequence[Lattice], saddles: SaddleIndex, level: Level) -> list[Lattice]:
    """Return `lattices` with all corners that can be added one after the other; brightness is read from `level`."""
    grown = list(lattices)
    growing = list(range(len(grown)))
    for _ in range(MAX_RINGS):
        if not growing:
            break
        added: list[int] = []
        for how in (STIFF, PLIANT):
            todo = [number for number in growing if number not in added]
            wide = [grown[number].padded(2) for number in todo]
            for number, before, after in zip(todo, wide, _ring(wide, saddles, level, *how), strict=True):
                if after.count > before.count:
                    grown[number] = after.trimmed()
                    added.append(number)
        growing = added
    return grown


def _ring(
    lattices: list[Lattice], saddles: SaddleIndex, level: Level, degree: int, ridge: tuple[float, float]
) -> list[Lattice]:
    """Return `lattices` (with two empty outer rows and columns) with those empty cells filled that can be."""
    if not lattices:
        return []
    sheet = Sheet.of(lattices)
    cells = _beside(sheet.known)
    fit = fit_cells(sheet.pixels, cells, degree=degree, width=1.3, ridge=ridge)
    cell = np.argwhere(cells)
    height, width = level.smooth.shape
    place = level.to_level(fit.pixels)
    usable = (fit.support >= 3) & (place > 0.0).all(axis=1) & (place < [width - 1, height - 1]).all(axis=1)
    index, found = saddles.nearest(fit.pixels, np.where(usable, REACH * _longest(fit), 0.0))
    owner, slot = np.nonzero(found & usable[:, None])
    pixels = saddles.pixels[index[owner, slot]]
    distance = _in_cells(fit, owner, pixels)
    near = distance < REACH
    owner, pixels, distance = owner[near], pixels[near], distance[near]
    if not len(owner):
        return lattices
    contrast, good = _fits(sheet, level, fit, cell, owner, pixels)
    owner, pixels, distance, contrast = owner[good], pixels[good], distance[good], contrast[good]
    order = np.lexsort((distance, owner))
    chosen, first = np.unique(owner[order], return_index=True)
    best = order[first]
    sheet.pixels[cell[chosen, 0], cell[chosen, 1]] = pixels[best]
    sheet.contrast[cell[chosen, 0], cell[chosen, 1]] = contrast[best]
    return sheet.lattices(lattices)


def _beside(known: BoolArray) -> BoolArray:
    """Return the empty cells next to known ones."""
    beside = np.zeros_like(known)
    beside[1:] |= known[:-1]
    beside[:-1] |= known[1:]
    beside[:, 1:] |= known[:, :-1]
    beside[:, :-1] |= known[:, 1:]
    return beside & ~known


def _longest(fit: LocalFit) -> FloatArray:
    longest: FloatArray = np.maximum(np.linalg.norm(fit.along_column, axis=1), np.linalg.norm(fit.along_row, axis=1))
    return longest


def _area(fit: LocalFit) -> FloatArray:
    a, b = fit.along_column, fit.along_row
    area: FloatArray = a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]
    return area


def _in_cells(fit: LocalFit, owner: IntArray, pixels: FloatArray) -> FloatArray:
    """Return how far `pixels` lie from the predictions of the cells `owner`, in cells (infinite for folded cells)."""
    off = pixels - fit.pixels[owner]
    a, b, area = fit.along_column[owner], fit.along_row[owner], _area(fit)[owner]
    safe = np.where(area > 1.0, area, np.nan)
    column = (off[:, 0] * b[:, 1] - off[:, 1] * b[:, 0]) / safe
    row = (a[:, 0] * off[:, 1] - a[:, 1] * off[:, 0]) / safe
    return np.nan_to_num(np.hypot(column, row), nan=np.inf)


def _fits(
    sheet: Sheet, level: Level, fit: LocalFit, cell: IntArray, owner: IntArray, pixels: FloatArray
) -> tuple[FloatArray, BoolArray]:
    """Return the contrast at `pixels` and whether they can be the corners of the cells `owner`."""
    local = level.to_level(pixels)
    height = _area(fit)[owner] / np.maximum(_longest(fit)[owner], 1e-9) / level.scale
    rings = read_rings(level.smooth, local, np.clip(RING * height, MIN_RING_PX, MAX_RING_PX))
    sign = sheet.signs[cell[owner, 0], cell[owner, 1]]
    a, b = fit.along_column[owner], fit.along_row[owner]
    first = np.where((sign > 0)[:, None], a, b)
    second = np.where((sign > 0)[:, None], b, a)
    good = rings.valid & _parallel(rings.angles[:, 0], first) & _parallel(rings.angles[:, 1], second)
    seen = np.zeros(len(owner), np.int64)
    for direction in range(4):
        beside = cell[owner] + STEPS[direction][::-1]
        neighbour = sheet.pixels[beside[:, 0], beside[:, 1]]
        there = np.isfinite(neighbour[:, 0])
        end = level.to_level(np.where(there[:, None], neighbour, pixels))
        length = np.linalg.norm(end - local, axis=1)
        side = sign if direction % 2 == 0 else -sign
        difference = edge_contrast(level.smooth, local, end, side, np.clip(0.12 * length, 1.0, 4.0))
        known = np.nan_to_num(sheet.contrast[beside[:, 0], beside[:, 1]], nan=0.0)
        weakest = CONTRAST_RATIO * np.minimum(known, rings.contrast)
        edge = (difference > weakest[:, None]).sum(axis=1) >= MOST
        good &= edge | ~there
        seen += there
    return rings.contrast, good & (seen > 0)


def _parallel(angle: FloatArray, vector: FloatArray) -> BoolArray:
    """Return whether lines at `angle` run along `vector` (M, 2)."""
    cross = np.cos(angle) * vector[:, 1] - np.sin(angle) * vector[:, 0]
    parallel: BoolArray = np.abs(cross) < LINE_SINE * np.linalg.norm(vector, axis=1)
    return parallel
