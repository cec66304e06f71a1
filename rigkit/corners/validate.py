"""Which lattices are boards: enough corners in closed squares, one board to a place, and of a known size if sizes are known."""

from __future__ import annotations

import numpy as np

from rigkit.arrays import BoolArray
from rigkit.corners.lattice import Lattice

__all__ = ["in_squares", "largest_part", "separate", "tidy"]


def in_squares(known: BoolArray) -> BoolArray:
    """Return which of the `known` corners (R, C) belong to a closed square of four."""
    square = known[:-1, :-1] & known[1:, :-1] & known[:-1, 1:] & known[1:, 1:]
    out = np.zeros_like(known)
    for rows in (slice(None, -1), slice(1, None)):
        for columns in (slice(None, -1), slice(1, None)):
            out[rows, columns] |= square
    return out


def largest_part(known: BoolArray) -> BoolArray:
    """Return the largest part of `known` (R, C) that hangs together by its squares."""
    import cv2

    square = known[:-1, :-1] & known[1:, :-1] & known[:-1, 1:] & known[1:, 1:]
    count, label, stats, _ = cv2.connectedComponentsWithStats(square.astype(np.uint8), connectivity=4)
    if count < 2:
        return np.zeros_like(known)
    best = label == 1 + int(stats[1:, cv2.CC_STAT_AREA].argmax())
    out = np.zeros_like(known)
    for rows in (slice(None, -1), slice(1, None)):
        for columns in (slice(None, -1), slice(1, None)):
            out[rows, columns] |= best
    return out


def tidy(lattice: Lattice) -> Lattice:
    """Return `lattice` without corners outside closed squares, trimmed."""
    if min(lattice.pixels.shape[:2]) < 2:
        return lattice.without(np.ones_like(lattice.known)).trimmed()
    return lattice.without(~largest_part(lattice.known)).trimmed()


def separate(lattices: list[Lattice], least: int) -> list[Lattice]:
    """Return the boards among `lattices`: at least `least` corners, 3x3 or more, and no corner shared with a larger one."""
    kept: list[Lattice] = []
    for lattice in sorted(lattices, key=lambda item: -item.count):
        if lattice.count < max(least, 9) or min(lattice.size) < 3:
            continue
        mine = lattice.pixels[lattice.known]
        if not any(_overlap(mine, other.pixels[other.known]) for other in kept):
            kept.append(lattice)
    return kept


def _overlap(mine: np.ndarray, theirs: np.ndarray) -> bool:
    from scipy.spatial import cKDTree

    distance, _ = cKDTree(theirs).query(mine)
    return bool((distance < 2.0).sum() > 1)
