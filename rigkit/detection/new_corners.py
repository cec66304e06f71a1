"""What another search of an image adds to the boards found before: only corners that these do not explain can show
more."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from rigkit.core.arrays import BoolArray, FloatArray, known_median
from rigkit.detection.lattice.lattice import Lattice
from rigkit.detection.lattice.local_fit import fit_cells, predicted
from rigkit.detection.subpixel.refined import RefinedLattice
from rigkit.kernels.front import near_any

SAME_PX, SAME_OF_CELL = 4.0, 0.1
"""Largest distance between the same corners fitted in the image and in a resampled part, px or (the larger) cells: the
effect of strong blur."""

NEXT_CELLS = 1.0
"""Largest distance of a corner from an empty place of a lattice, or from one next to it, in typical sides of its cells,
for the lattice to be searched again: the corner, or one that grows from it, may belong there. Compared with searching
always no corner of a REAL image is lost, and of 220 that were blurred, moved, halved, cropped or brightened one corner
of one board and a grid of uncertain ones (0.5 px); with 0.5 seven corners of four more boards."""


def new_corners(found: Sequence[RefinedLattice], pixels: FloatArray) -> tuple[BoolArray, bool]:
    """Return which of the corners `pixels` (N, 2) are not among those of the lattices `found`, and whether one of these
    may belong to a lattice: it is at an empty place of it or next to it."""
    known = np.concatenate([item.lattice.pixels[item.lattice.known] for item in found])
    new = ~near_any(pixels, known, SAME_PX)
    rest = pixels[new]
    return new, len(rest) > 0 and any(_may_belong(item, rest) for item in found)


def _may_belong(item: RefinedLattice, pixels: FloatArray) -> bool:
    """Return whether one of `pixels` (N, 2) is at an empty place of a lattice or next to it."""
    wide = item.lattice.padded((1, 1), (1, 1))
    places = predicted(wide.pixels, ~wide.known)
    # Far from all corners nothing is predicted.
    places = places.of(places.support > 0.0)
    return bool(near_any(pixels, places.pixels, NEXT_CELLS * float(np.median(places.cell_px()))).any())


def same_corner_px(lattice: Lattice) -> float:
    """Return the largest distance, px, between the corners of `lattice` and the same ones fitted otherwise."""
    return max(SAME_PX, SAME_OF_CELL * known_median(fit_cells(lattice.pixels, lattice.known).cell_px()))


def is_mostly(lattice: Lattice, pixels: FloatArray, same_px: float = SAME_PX) -> bool:
    """Return whether most corners of `lattice` are among `pixels` (N, 2)."""
    same = near_any(lattice.pixels[lattice.known], pixels, same_px)
    return 2 * int(np.count_nonzero(same)) > lattice.count


def with_better(found: list[RefinedLattice], others: Sequence[RefinedLattice]) -> list[RefinedLattice]:
    """Return `found` with `others` in place of lattices with mostly the same corners, and no more in total."""
    for item in others:
        mine = item.lattice.pixels[item.lattice.known]
        same_px = same_corner_px(item.lattice)
        same = [one for one in found if is_mostly(one.lattice, mine, same_px)]
        if sum(one.lattice.count for one in same) <= item.lattice.count:
            found = [one for one in found if not any(one is other for other in same)] + [item]
    return found
