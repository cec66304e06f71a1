"""Validation of lattices: stray rows, duplicates, edges between corners, completeness, known sizes."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from rigkit.core.arrays import BoolArray, FloatArray
from rigkit.detection.checks.evidence import Evidence
from rigkit.detection.lattice.lattice import MANY_CORNERS, MIN_ROWS, Lattice
from rigkit.detection.lattice.local_fit import MIN_PREDICTING, STIFF, fit_cells
from rigkit.detection.saddles.response import Level
from rigkit.detection.saddles.saddle import SAME_CORNER_PX
from rigkit.detection.subpixel.refined import RefinedLattice
from rigkit.kernels import lattice as native
from rigkit.kernels.front import near_any

STRAY_ROW = 2
"""Largest number of corners of a stray outer row, which does not belong to the board."""

FRAME_CELLS = 0.5
"""Corners predicted closer than this to the image border, in cells, may be missing."""

MAX_SHARED = 0.25
"""Largest share of a lattice's corners that belong to larger ones too: those of a lattice grown across a discontinuity
are two rows, of a board found on two levels of the pyramid nearly all."""

MAX_LOST = 0.4
"""Largest share of a lattice's corners that the sub-pixel fit may reject: on partly covered boards it rejects many."""

LARGE_SAMPLE, SAMPLE, RAGGED = 7, 5, 0.75
"""Rows and columns of the sample of a lattice with many corners, of that of a ragged lattice, and the share of corners
in rows times columns below which a lattice is ragged."""

STEPS_ACROSS, MAX_EDGES = 16, 256
"""Samples across an edge between two corners, and the largest number of edges, by which edge offsets are measured."""

NARROW_STRIPE, MAX_DARK, MAX_BRIGHT = 0.12, 0.024, 0.036
"""Half width of the stripe in which the edge is sought halfway between two corners, and its largest median offset from
their line to the dark or the bright side, in squares. On 300 boards it is 0.01 and 0.016; lenses bend edges to both
sides alike."""

WIDE_STRIPE, OFFSET_PARTS, MAX_SHIFT, MAX_BOW = 0.25, (0.2, 0.5, 0.8), 0.1, 0.04
"""Half width of a wider stripe, positions along the edge, and the largest shift and bow there, in squares. Spreading
ink, thin print and saturation shift edges by up to 0.08, equally along their length. Rounded corners bow them by 0.01;
threads shift by 0.15, dots by 0.08 to 0.2, and bow as much."""

NEARLY_FULL, BY_CHANCE = 0.9, 24
"""A lattice is compact if it has at least BY_CHANCE corners, or a share of NEARLY_FULL of its rows times columns, or a
full block of BY_CHANCE squares. Codes and mosaics have such blocks in hardly one of 2^23 places, and one
crooked chain of 24 corners in 126 pages."""

MAX_EXTRA = 2
"""Largest number of additional rows and columns of a grid larger than its board."""

WORSE_FIT = 1.5
"""Smallest ratio of the residuals of additional rows to those of the board's corners."""


def without_stray_rows(lattice: Lattice, size_px: tuple[int, int]) -> Lattice:
    """Return `lattice` without stray outer rows, trimmed.

    `size_px` is the (width, height) of the full-resolution image.
    """
    while (stray := stray_row(lattice, size_px)) is not None:
        lattice = lattice.without(stray).trimmed()
    return lattice


def stray_row(lattice: Lattice, size_px: tuple[int, int]) -> BoolArray | None:
    """Return the first stray outer row or column as a mask (R, C), None if there is none.

    Such a row has few corners, although more of its predicted corners are within the image.
    """
    known = lattice.known
    if min(known.shape) < 3:
        return None
    for outer in ((0, slice(None)), (-1, slice(None)), (slice(None), 0), (slice(None), -1)):
        have = int(np.count_nonzero(known[outer]))
        if have > STRAY_ROW:
            continue
        row = np.zeros_like(known)
        row[outer] = True
        rest = lattice.without(row)
        missing = row & ~known
        shape = fit_cells(rest.pixels, missing, radius=3, **STIFF._asdict())
        side = np.abs(shape.along_column) + np.abs(shape.along_row)
        margin = FRAME_CELLS * side
        inside = (shape.pixels > margin) & (shape.pixels < np.array(size_px) - 1.0 - margin)
        if have < int((inside.all(axis=1) & (shape.support >= MIN_PREDICTING)).sum()):
            return row
    return None


def is_large_enough(lattice: Lattice, min_corners: int) -> bool:
    """Return whether `lattice` has `min_corners` and, if these are 9 or more, three rows and three columns."""
    return lattice.count >= min_corners and min(lattice.size) >= (MIN_ROWS if min_corners >= MIN_ROWS**2 else 2)


def without_shared_corners(lattices: Sequence[Lattice], min_corners: int) -> list[Lattice]:
    """Return those of `lattices` that are large enough, without the corners that they share with larger ones.

    A lattice that shares many of its corners is a duplicate and left out; one that grew across the border of another
    board keeps its own corners.
    """
    candidates = sorted((item for item in lattices if is_large_enough(item, min_corners)), key=lambda item: -item.count)
    if len(candidates) < 2:
        return candidates
    corners = [item.pixels[item.known] for item in candidates]
    low = np.array([mine.min(axis=0) for mine in corners]) - SAME_CORNER_PX
    high = np.array([mine.max(axis=0) for mine in corners])
    kept: list[Lattice] = []
    for k, (item, mine) in enumerate(zip(candidates, corners, strict=True)):
        touching = ((low[:k] < high[k]) & (low[k] < high[:k])).all(axis=1)
        shared = np.zeros(len(mine), np.bool_)
        for other in np.flatnonzero(touching):
            again = near_any(mine, corners[other], SAME_CORNER_PX)
            # A single corner may belong to both: two boards that touch there.
            if np.count_nonzero(again) > 1:
                shared |= again
        rest = _without_shared(item, shared)
        if rest is not None and is_large_enough(rest, min_corners):
            kept.append(rest)
    return kept


def _without_shared(lattice: Lattice, shared: BoolArray) -> Lattice | None:
    """Return `lattice` without those of its corners (N,) that are `shared`; None if more than MAX_SHARED are."""
    if not shared.any():
        return lattice
    if np.count_nonzero(shared) > MAX_SHARED * len(shared):
        return None
    drop = lattice.known.copy()
    drop[lattice.known] = shared
    return lattice.without(drop).trimmed()


def sample_of(lattice: Lattice) -> Lattice | None:
    """Return the fullest block of a few rows and columns of a large or ragged lattice; None for other lattices.

    It serves to reject quickly lattices such as those of pages of dots, with thousands of corners and many gaps.
    """
    known = lattice.known
    many = lattice.count >= MANY_CORNERS
    side = LARGE_SAMPLE if many else SAMPLE
    if min(known.shape) < side or (not many and not side**2 <= lattice.count < RAGGED * known.size):
        return None
    full = sliding_window_view(known, (side, side)).sum(axis=(2, 3))
    row, column = (int(at) for at in np.unravel_index(full.argmax(), full.shape))
    return lattice.cut(slice(row, row + side), slice(column, column + side))


def has_edge_offset(lattice: Lattice, level: Level) -> bool:
    """Return whether the edges of `lattice` on `level` are off the lines between their corners, or bowed."""
    reach = (NARROW_STRIPE, *(WIDE_STRIPE for _ in OFFSET_PARTS))
    shift, start, middle, end = _edge_offsets(lattice, level, reach, (0.5, *OFFSET_PARTS))
    if -MAX_DARK < shift < MAX_BRIGHT:
        # Edges of discs that touch are hardly off in the narrow stripe. Markers are on the bright side of edges.
        return bool(-WIDE_STRIPE < middle < 0.0 and middle - 0.5 * (start + end) < -MAX_BOW)
    return not abs(middle) < MAX_SHIFT or _bowed(start, middle, end)


def has_bowed_edges(lattice: Lattice, level: Level) -> bool:
    """Return whether the edges of `lattice` on `level` are bowed, as those of discs are."""
    return _bowed(*_edge_offsets(lattice, level, [WIDE_STRIPE for _ in OFFSET_PARTS], OFFSET_PARTS))


def _bowed(start: float, middle: float, end: float) -> bool:
    return not abs(middle - 0.5 * (start + end)) < MAX_BOW


def _edge_offsets(lattice: Lattice, level: Level, reach: Sequence[float], along: Sequence[float]) -> FloatArray:
    """Return the offsets (K,), in squares, of edges to the dark side of their corners' line at parts `along` (K,) of
    it.

    The edges are searched within `reach` (K,) squares on both sides.
    """
    seen = (level.smooth, level.scale, level.offset)
    return native.shifts_of_edges(lattice.pixels, lattice.rising, *seen, reach, along, STEPS_ACROSS, MAX_EDGES)


def is_compact(lattice: Lattice, size_px: tuple[int, int]) -> bool:
    """Return whether `lattice` is large, nearly full, or has a large full block; `size_px` is (width, height).

    Squares of random brightness that happen to alternate make crooked chains of corners. On boards that are partly
    covered, or cut by the image border, full blocks remain.
    """
    known = lattice.known
    if lattice.count >= BY_CHANCE or known.mean() >= NEARLY_FULL:
        return True
    missing = fit_cells(lattice.pixels, ~known, degree=1)
    full = known.copy()
    full[~known] = ((missing.pixels < 0.0) | (missing.pixels > np.array(size_px) - 1.0)).any(axis=1)
    rows, columns = full.shape
    for high in range(2, rows + 1):
        wide = max(2, -(-BY_CHANCE // (high + 1)) - 1)
        if wide <= columns and sliding_window_view(full, (high, wide)).all(axis=(2, 3)).any():
            return True
    return False


def is_board(refined: RefinedLattice, before: int, min_corners: int, prior: float = 0.0) -> bool:
    """Return whether the fit of a lattice of `before` corners is a board.

    It must keep most corners, and its evidence score plus `prior` must be positive.
    """
    lattice = refined.lattice
    if lattice.count < (1.0 - MAX_LOST) * before or not is_large_enough(lattice, min_corners):
        return False
    return Evidence.of(refined).score + prior > 0.0


def exceeds_known_sizes(lattice: Lattice, sizes: Sequence[tuple[int, int]]) -> bool:
    """Return whether `lattice` is larger than all of the known `sizes` by more than stray rows; False for none."""
    short, long = sorted(lattice.size)
    return bool(sizes) and all(short > min(size) + MAX_EXTRA or long > max(size) + MAX_EXTRA for size in sizes)


def part_of_known_size(refined: RefinedLattice, sizes: Sequence[tuple[int, int]]) -> RefinedLattice:
    """Return the part of a grid that is a board of a known size, if its additional rows clearly do not belong to it.

    The border or the background of a board sometimes gives a row of few corners, or of corners with large residuals.
    A grid of a known size, or one whose additional rows are as good as the others, is returned unchanged.
    """
    rows, columns = refined.lattice.known.shape
    both = {(r, c) for c, r in sizes} | {(c, r) for c, r in sizes}
    if (rows, columns) in both or not both:
        return refined
    relative = refined.residual / np.where(refined.lattice.known, refined.lattice.contrast, 1.0)
    best: tuple[int, float, RefinedLattice] | None = None
    for r, c in both:
        if r > rows or c > columns or rows - r + columns - c > MAX_EXTRA:
            continue
        for top in range(rows - r + 1):
            for left in range(columns - c + 1):
                part = (slice(top, top + r), slice(left, left + c))
                inside = np.zeros((rows, columns), bool)
                inside[part] = True
                if not _has_foreign_rows(refined.lattice.known, relative, inside):
                    continue
                rank = (int(refined.lattice.known[part].sum()), -float(np.nanmedian(relative[part])))
                if best is None or rank > best[:2]:
                    best = (*rank, refined.cut(*part))
    return refined if best is None else best[2]


def _has_foreign_rows(known: BoolArray, relative: np.ndarray, inside: BoolArray) -> bool:
    """Return whether the corners inside are nearly complete, and those outside are few or have large residuals."""
    outside = ~inside
    if known[inside].mean() < 0.9:
        return False
    few = known[outside].mean() < 0.5
    return bool(few or np.nanmedian(relative[outside & known]) > WORSE_FIT * np.nanmedian(relative[inside & known]))
