"""Growth of a lattice ring by ring, filling holes, up to the border of the board.

Each empty cell next to known corners is predicted from its neighbourhood. A saddle near the prediction is added if it
is a corner of the expected polarity and directions, and if there are edges to its neighbours.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from functools import cache

import numpy as np

from rigkit.core.arrays import FloatArray
from rigkit.detection.lattice.lattice import MANY_CORNERS, Lattice
from rigkit.detection.lattice.links import (
    CONTRAST_RATIO,
    EDGE_PLACES,
    LATERAL_LENGTHS,
    MAX_LATERAL_PX,
    MIN_EDGE_PLACES,
    MIN_LATERAL_PX,
)
from rigkit.detection.lattice.local_fit import FLEXIBLE, MIN_PREDICTING, PREDICTION_WIDTH, STIFF
from rigkit.detection.saddles.response import Level
from rigkit.detection.saddles.ring import ring_rules
from rigkit.detection.saddles.saddle import Saddles
from rigkit.kernels.front import near_any
from rigkit.kernels.growth import FitRules, GridBuckets, GrowthRules, grown

MAX_RINGS = 60
"""Upper bound of the rings, more than any board has rows or columns."""

ROOM = 6
"""Empty rows and columns added around a lattice at a time, into which it grows."""

FIT_RADIUS = 3
"""Radius of the predictions, cells."""

MAX_GROWN, MAX_FAILED_GROWTHS = 96, 16
"""Largest number of lattices that are grown, and of successive ones that are no boards: boards come first, being
larger, while clutter may give hundreds of single squares."""

GROWTH_REACH = 0.25
"""Largest distance of a corner from its prediction, in cells."""

MAX_SADDLES_TRIED = 6
"""Largest number of saddles tried per cell."""

RING = 0.3
"""Radius of the ring in heights of the cell, so that it is within the four squares."""

MIN_RING_PX, MAX_RING_PX = 2.2, 9.0

ODD, CENTRE = 0.35, 0.35
"""As `ring.MAX_ODD` and `ring.MAX_CENTRE`, but larger, as the lattice predicts position and directions of the saddle: a
shadow edge may cross it, and the ring may extend beyond the squares of oblique or small cells."""

LINE_SINE = float(np.sin(np.radians(25.0)))
"""Sine of the largest angle between the ring's lines and the lattice."""

MIN_AREA_PX2 = 1.0
"""Smallest area of a cell, px^2."""

GROWN_AGAIN_PX = 1.4
"""A lattice most of whose corners are closer than this to corners of grown ones is one of these, found on two levels.
With 2 px another seed grows on one of 967 REAL images, blurred by 3 px, and 15 of 399 corners are lost."""


def grow_all(
    lattices: Iterable[Lattice], saddles: Saddles, level: Level, plausible: Callable[[Lattice], bool]
) -> list[Lattice]:
    """Return the lattices grown from `lattices` to `saddles`, one by one, skipping those that others cover already.

    Lattices that are not `plausible` are left out.
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
    """Return the grown `lattice`, and whether it is `plausible`; brightness is read from `level`.

    Large lattices are tested early; one that is not plausible may not be fully grown.
    """
    rings, tested = MAX_RINGS, False
    while rings > 0:
        if not tested and lattice.count >= MANY_CORNERS:
            if not plausible(lattice):
                return lattice, False
            tested = True
        # The kernel changes these arrays until it reaches their border or adds no more (rings -1).
        wide = lattice.padded((ROOM, ROOM), (ROOM, ROOM))
        sheet = (wide.pixels, wide.contrast, 1.0 if wide.rising else -1.0)
        rings = grown(*sheet, level.smooth, level.scale, level.offset, saddles, _rules(), rings)
        if wide.count > lattice.count:
            lattice = wide.trimmed()
    return lattice, tested or plausible(lattice)


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
    predictions = [FitRules(degree, FIT_RADIUS, False, PREDICTION_WIDTH, ridge) for degree, ridge in (STIFF, FLEXIBLE)]
    return GrowthRules.make(predictions, ring_rules(ODD, CENTRE), EDGE_PLACES, **numbers)
