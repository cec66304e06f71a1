"""Growing a lattice ring by ring: fills holes, reaches the edges of the board, and never jumps to another board.

Each empty cell next to known corners is predicted from its neighbourhood; a saddle near the prediction is taken if it
is a corner with the polarity and the directions that the lattice demands and if the edges to its neighbours are seen.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import replace
from functools import cache, cached_property
from typing import TYPE_CHECKING

import numpy as np

from rigkit.core.arrays import BoolArray, FloatArray, IntArray
from rigkit.detection.lattice.lattice import GRID_DIRECTIONS, MANY, Lattice
from rigkit.detection.lattice.links import (
    ASIDE,
    CONTRAST_RATIO,
    EDGE_PLACES,
    MAX_ASIDE_PX,
    MIN_ASIDE_PX,
    MIN_EDGE_PLACES,
    edge_contrast,
)
from rigkit.detection.lattice.local_fit import LocalFit, fit_cells
from rigkit.detection.saddles.nearby import near_any
from rigkit.detection.saddles.response import Level
from rigkit.detection.saddles.ring import read_rings, ring_rules
from rigkit.detection.saddles.saddle import Saddles
from rigkit.kernels import kernels
from rigkit.kernels.growth import FitRules, GrowthRules, Squares, grown

if TYPE_CHECKING:
    from scipy.spatial import cKDTree

__all__ = ["SaddleIndex", "grow_all"]

MAX_RINGS = 60
"""More rings than any board has rows or columns."""

ROOM = 6
"""Empty rows and columns around a lattice for it to grow into, before it is given more."""

STIFF = (2, (0.02, 1.0))
PLIANT = (3, (1e-3, 1e-2))
"""Degree and ridge of the prediction: one is steady with few neighbours, the other follows the rim of a fisheye."""

FIT_WIDTH, FIT_RADIUS = 1.3, 3
"""Standard deviation of the weight and reach of the predictions, cells."""

MIN_FORETELLING = 3
"""Known corners that foretell another."""

MAX_GROWN, MAX_FRUITLESS = 96, 16
"""So many lattices are grown, or so many in a row without a board: those of boards come first, being larger, and
clutter can make hundreds, of one square each."""

GROWTH_REACH = 0.25
"""A corner lies within this of its prediction, in cells."""

MAX_SADDLES_TRIED = 6
"""Saddles tried for a cell."""

RING = 0.3
"""Radius of the ring in heights of the cell: well inside the four squares."""

MIN_RING_PX, MAX_RING_PX = 2.2, 9.0

ODD, CENTRE = 0.35, 0.35
"""As `ring.MAX_ODD` and `ring.MAX_CENTRE`, for a saddle whose place and directions the lattice foretells: the edge of a
shadow may cross it, and the ring may reach beyond the squares of flat or small cells."""

LINE_SINE = float(np.sin(np.radians(25.0)))
"""How well the ring's lines must follow the lattice."""

MIN_AREA_PX2 = 1.0
"""Cells of fewer px^2 are none."""

GROWN_AGAIN_PX = 1.4
"""Corners nearer than this are one: found again on a coarser level."""


class SaddleIndex:
    """All saddles of an image, ready to be asked for the nearest."""

    def __init__(self, saddles: Saddles) -> None:
        self.pixels = saddles.pixels

    @cached_property
    def _tree(self) -> cKDTree:
        from scipy.spatial import cKDTree

        return cKDTree(self.pixels)

    @cached_property
    def squares(self) -> Squares:
        """The saddles as the kernels want them."""
        return Squares.sorted(self.pixels)

    def nearest(self, pixels: FloatArray, reach_px: FloatArray) -> tuple[IntArray, BoolArray]:
        """Return the MAX_SADDLES_TRIED nearest saddles of each of `pixels` (M, 2), and which lie within `reach_px`."""
        if not len(self.pixels) or not len(pixels):
            none = (len(pixels), MAX_SADDLES_TRIED)
            return np.zeros(none, np.int64), np.zeros(none, bool)
        distance, index = self._tree.query(pixels, k=MAX_SADDLES_TRIED)
        found = distance <= reach_px[:, None]
        return np.where(found, index, 0), found


def grow_all(
    lattices: Iterable[Lattice], saddles: SaddleIndex, level: Level, promising: Callable[[Lattice], bool]
) -> list[Lattice]:
    """Return the lattices grown from `lattices` one by one, without what others have grown over.

    Those that are not `promising`, as soon as there is enough of them to tell, are left out.
    """
    out: list[Lattice] = []
    taken = np.zeros((0, 2))
    grown = fruitless = 0
    for lattice in lattices:
        if grown == MAX_GROWN or fruitless == MAX_FRUITLESS:
            break
        if _covered(lattice, taken):
            continue
        lattice, good = _grown(lattice, saddles, level, promising)
        grown += 1
        taken = np.concatenate([taken, lattice.pixels[lattice.known]])
        fruitless = 0 if good and lattice.solid else fruitless + 1
        if good:
            out.append(lattice)
    return out


def _covered(lattice: Lattice, corners: FloatArray) -> bool:
    """Return whether most of the corners of `lattice` are among `corners` (M, 2)."""
    near = near_any(lattice.pixels[lattice.known], corners, GROWN_AGAIN_PX)
    return 2 * int(np.count_nonzero(near)) > len(near)


def _grown(
    lattice: Lattice, saddles: SaddleIndex, level: Level, promising: Callable[[Lattice], bool]
) -> tuple[Lattice, bool]:
    """Return `lattice` with all corners that can be added one after the other, and whether it is `promising`.

    Brightness is read from `level`. A lattice that is not promising may not be fully grown.
    """
    rings, judged = MAX_RINGS, False
    while rings > 0:
        if not judged and lattice.count >= MANY:
            if not promising(lattice):
                return lattice, False
            judged = True
        wide = lattice.padded((ROOM, ROOM), (ROOM, ROOM))
        rings = _grow(wide, saddles, level, rings)
        if wide.count > lattice.count:
            lattice = wide.trimmed()
    return lattice, judged or promising(lattice)


def _grow(lattice: Lattice, saddles: SaddleIndex, level: Level, rings: int) -> int:
    """Grow a `lattice` that nobody has looked at yet IN PLACE, by at most so many `rings`, each from all known before.

    Returns the rings that are left when it has reached the border of its arrays, -1 when it has grown all it can.
    """
    library = kernels()
    if library is not None:
        sheet = (lattice.pixels, lattice.contrast, 1.0 if lattice.rising else -1.0)
        brightness = (level.smooth, level.scale, level.offset)
        return grown(*sheet, *brightness, saddles.squares, _rules(), rings)
    due = np.ones((2, *lattice.contrast.shape), bool)
    for left in range(rings, 0, -1):
        # A new look at corners that have changed.
        lattice = replace(lattice)
        known = lattice.known
        if known[0].any() or known[-1].any() or known[:, 0].any() or known[:, -1].any():
            return left
        for way, (degree, ridge) in enumerate((STIFF, PLIANT)):
            cells = _beside(known) & due[way]
            due[way] &= ~cells
            fit = fit_cells(lattice.pixels, cells, degree=degree, radius=FIT_RADIUS, width=FIT_WIDTH, ridge=ridge)
            added = _added(lattice, np.argwhere(cells), fit, saddles, level)
            if added.any():
                break
        else:
            return -1
        # What failed before may be foretold otherwise now, within the reach of the fits.
        due |= _widened(added)
    return -1


@cache
def _rules() -> GrowthRules:
    numbers: dict[str, float] = {
        "most": MIN_EDGE_PLACES,
        "tried": MAX_SADDLES_TRIED,
        "fewest": MIN_FORETELLING,
        "reach": GROWTH_REACH,
        "ring_part": RING,
        "min_ring": MIN_RING_PX,
        "max_ring": MAX_RING_PX,
        "line_sine": LINE_SINE,
        "contrast_ratio": CONTRAST_RATIO,
        "aside": ASIDE,
        "min_aside": MIN_ASIDE_PX,
        "max_aside": MAX_ASIDE_PX,
        "least_area": MIN_AREA_PX2,
    }
    predictions = [FitRules(degree, FIT_RADIUS, False, FIT_WIDTH, ridge) for degree, ridge in (STIFF, PLIANT)]
    return GrowthRules.make(predictions, ring_rules(ODD, CENTRE), EDGE_PLACES, **numbers)


def _widened(cells: BoolArray) -> BoolArray:
    """Return the cells within FIT_RADIUS of `cells`."""
    rows, columns = cells.shape
    padded = np.pad(cells, FIT_RADIUS)
    windows = np.lib.stride_tricks.sliding_window_view(padded, (2 * FIT_RADIUS + 1, 2 * FIT_RADIUS + 1))
    widened: BoolArray = windows.any(axis=(2, 3)).reshape(rows, columns)
    return widened


def _added(lattice: Lattice, cell: IntArray, fit: LocalFit, saddles: SaddleIndex, level: Level) -> BoolArray:
    """Fill those of the cells `cell` (M, 2) of `lattice`, foretold by `fit`, that can be; return which (R, C)."""
    added = np.zeros(lattice.known.shape, bool)
    height, width = level.smooth.shape
    place = level.to_level(fit.pixels)
    usable = (
        (fit.support >= MIN_FORETELLING) & (place > 0.0).all(axis=1) & (place < [width - 1, height - 1]).all(axis=1)
    )
    index, found = saddles.nearest(fit.pixels, np.where(usable, GROWTH_REACH * _longest(fit), 0.0))
    owner, slot = np.nonzero(found & usable[:, None])
    pixels = saddles.pixels[index[owner, slot]]
    distance = _in_cells(fit, owner, pixels)
    near = distance < GROWTH_REACH
    owner, pixels, distance = owner[near], pixels[near], distance[near]
    if not len(owner):
        return added
    contrast, good = _fits(lattice, level, fit, cell, owner, pixels)
    owner, pixels, distance, contrast = owner[good], pixels[good], distance[good], contrast[good]
    order = np.lexsort((distance, owner))
    chosen, first = np.unique(owner[order], return_index=True)
    best = order[first]
    row, column = cell[chosen].T
    lattice.pixels[row, column], lattice.contrast[row, column] = pixels[best], contrast[best]
    added[row, column] = True
    return added


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


def _in_cells(fit: LocalFit, owner: IntArray, pixels: FloatArray) -> FloatArray:
    """Return how far `pixels` lie from the predictions of the cells `owner`, in cells (infinite for folded cells)."""
    off = pixels - fit.pixels[owner]
    a, b, area = fit.along_column[owner], fit.along_row[owner], fit.areas()[owner]
    safe = np.where(area > MIN_AREA_PX2, area, np.nan)
    column = (off[:, 0] * b[:, 1] - off[:, 1] * b[:, 0]) / safe
    row = (a[:, 0] * off[:, 1] - a[:, 1] * off[:, 0]) / safe
    return np.nan_to_num(np.hypot(column, row), nan=np.inf)


def _fits(
    lattice: Lattice, level: Level, fit: LocalFit, cell: IntArray, owner: IntArray, pixels: FloatArray
) -> tuple[FloatArray, BoolArray]:
    """Return the contrast at `pixels` and whether they can be the corners of the cells `owner`."""
    local = level.to_level(pixels)
    height = fit.areas()[owner] / np.maximum(_longest(fit)[owner], 1e-9) / level.scale
    rings = read_rings(level.smooth, local, np.clip(RING * height, MIN_RING_PX, MAX_RING_PX), ODD, CENTRE)
    sign = lattice.signs()[cell[owner, 0], cell[owner, 1]]
    a, b = fit.along_column[owner], fit.along_row[owner]
    first = np.where((sign > 0)[:, None], a, b)
    second = np.where((sign > 0)[:, None], b, a)
    good = rings.valid & _parallel(rings.angles[:, 0], first) & _parallel(rings.angles[:, 1], second)
    # Few pass, so only theirs are the edges that are read.
    good[good] = _edges_seen(lattice, level, cell[owner[good]], local[good], sign[good], rings.contrast[good])
    return rings.contrast, good


def _edges_seen(
    lattice: Lattice, level: Level, cell: IntArray, local: FloatArray, sign: FloatArray, contrast: FloatArray
) -> BoolArray:
    """Return whether the edges from `local` (M, 2), in the cells `cell` (M, 2), to all known neighbours are there."""
    beside = cell[:, None] + GRID_DIRECTIONS[:, ::-1]
    inside = ((beside >= 0) & (beside < lattice.known.shape)).all(axis=2)
    row, column = np.moveaxis(np.where(inside[..., None], beside, 0), 2, 0)
    which, direction = np.nonzero(inside & lattice.known[row, column])
    end = level.to_level(lattice.pixels[row, column][which, direction])
    length = np.linalg.norm(end - local[which], axis=1)
    side = np.where(direction % 2 == 0, sign[which], -sign[which])
    aside = np.clip(ASIDE * length, MIN_ASIDE_PX, MAX_ASIDE_PX)
    difference = edge_contrast(level.smooth, local[which], end, side, aside)
    weakest = CONTRAST_RATIO * np.minimum(lattice.contrast[row, column][which, direction], contrast[which])
    seen = np.ones(len(cell), np.bool_)
    seen[which[(difference > weakest[:, None]).sum(axis=1) < MIN_EDGE_PLACES]] = False
    return seen


def _parallel(angle: FloatArray, vector: FloatArray) -> BoolArray:
    """Return whether lines at `angle` run along `vector` (M, 2)."""
    cross = np.cos(angle) * vector[:, 1] - np.sin(angle) * vector[:, 0]
    parallel: BoolArray = np.abs(cross) < LINE_SINE * np.linalg.norm(vector, axis=1)
    return parallel
