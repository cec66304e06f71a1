"""Growing a lattice ring by ring: fills holes, reaches the edges of the board, and never jumps to another board.

Each empty cell next to known corners is predicted from its neighbourhood; a saddle near the prediction is taken if it
is a corner with the polarity and the directions that the lattice demands and if the edges to its neighbours are seen.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from functools import cache

import numpy as np

from rigkit.core.arrays import FloatArray
from rigkit.detection.lattice.lattice import MANY, Lattice
from rigkit.detection.lattice.links import (
    CONTRAST_RATIO,
    EDGE_PLACES,
    LATERAL_LENGTHS,
    MAX_LATERAL_PX,
    MIN_EDGE_PLACES,
    MIN_LATERAL_PX,
)
from rigkit.detection.lattice.local_fit import FLEXIBLE, STIFF
from rigkit.detection.saddles.response import Level
from rigkit.detection.saddles.ring import ring_rules
from rigkit.detection.saddles.saddle import Saddles
from rigkit.kernels.front import near_any
from rigkit.kernels.growth import FitRules, GridBuckets, GrowthRules, grown

MAX_RINGS = 60
"""More rings than any board has rows or columns."""

ROOM = 6
"""Empty rows and columns around a lattice for it to grow into, before it is given more."""

FIT_WIDTH, FIT_RADIUS = 1.3, 3
"""Standard deviation of the weight and reach of the predictions, cells."""

MIN_PREDICTING = 3
"""Known corners that foretell another."""

MAX_GROWN, MAX_FAILED_GROWTHS = 96, 16
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


def grow_all(
    lattices: Iterable[Lattice], saddles: Saddles, level: Level, plausible: Callable[[Lattice], bool]
) -> list[Lattice]:
    """Return the lattices grown from `lattices` one by one to `saddles`, without what others have grown over.

    Those that are not `plausible`, as soon as there is enough of them to tell, are left out.
    """
    out: list[Lattice] = []
    taken = np.zeros((0, 2))
    tried = failed = 0
    squares: GridBuckets | None = None
    for lattice in lattices:
        if tried == MAX_GROWN or failed == MAX_FAILED_GROWTHS:
            break
        if _covered(lattice, taken):
            continue
        squares = squares or GridBuckets.sorted(saddles.pixels)
        lattice, good = _grown(lattice, squares, level, plausible)
        tried += 1
        taken = np.concatenate([taken, lattice.pixels[lattice.known]])
        failed = 0 if good and lattice.solid else failed + 1
        if good:
            out.append(lattice)
    return out


def _covered(lattice: Lattice, corners: FloatArray) -> bool:
    """Return whether most of the corners of `lattice` are among `corners` (M, 2)."""
    if not len(corners):
        return False
    near = near_any(lattice.pixels[lattice.known], corners, GROWN_AGAIN_PX)
    return 2 * int(np.count_nonzero(near)) > len(near)


def _grown(
    lattice: Lattice, saddles: GridBuckets, level: Level, plausible: Callable[[Lattice], bool]
) -> tuple[Lattice, bool]:
    """Return `lattice` with all corners that can be added one after the other, and whether it is `plausible`.

    Brightness is read from `level`. A lattice that is not promising may not be fully grown.
    """
    rings, judged = MAX_RINGS, False
    while rings > 0:
        if not judged and lattice.count >= MANY:
            if not plausible(lattice):
                return lattice, False
            judged = True
        wide = lattice.padded((ROOM, ROOM), (ROOM, ROOM))
        rings = _grow(wide, saddles, level, rings)
        if wide.count > lattice.count:
            lattice = wide.trimmed()
    return lattice, judged or plausible(lattice)


def _grow(lattice: Lattice, saddles: GridBuckets, level: Level, rings: int) -> int:
    """Grow a `lattice` that nobody has looked at yet IN PLACE, by at most so many `rings`, each from all known before.

    Returns the rings that are left when it has reached the border of its arrays, -1 when it has grown all it can.
    """
    sheet = (lattice.pixels, lattice.contrast, 1.0 if lattice.rising else -1.0)
    return grown(*sheet, level.smooth, level.scale, level.offset, saddles, _rules(), rings)


@cache
def _rules() -> GrowthRules:
    numbers: dict[str, float] = {
        "min_places": MIN_EDGE_PLACES,
        "tried": MAX_SADDLES_TRIED,
        "min_predicting": MIN_PREDICTING,
        "reach": GROWTH_REACH,
        "ring_part": RING,
        "min_ring": MIN_RING_PX,
        "max_ring": MAX_RING_PX,
        "line_sine": LINE_SINE,
        "contrast_ratio": CONTRAST_RATIO,
        "lateral": LATERAL_LENGTHS,
        "min_lateral": MIN_LATERAL_PX,
        "max_lateral": MAX_LATERAL_PX,
        "min_area": MIN_AREA_PX2,
    }
    predictions = [FitRules(degree, FIT_RADIUS, False, FIT_WIDTH, ridge) for degree, ridge in (STIFF, FLEXIBLE)]
    return GrowthRules.make(predictions, ring_rules(ODD, CENTRE), EDGE_PLACES, **numbers)
