"""Links between corners that are neighbours along an edge of a chessboard.

Links use local evidence only, for any number of boards, any perspective and any lens. Each corner is in the direction
of an arm of the other, the two arms have opposite polarity, and the edge between them is dark and bright on the sides
that the arms predict.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass

import numpy as np

from rigkit.core.arrays import FloatArray, IntArray
from rigkit.detection.saddles.response import Level
from rigkit.detection.saddles.ring import line_vectors
from rigkit.detection.saddles.saddle import Corners
from rigkit.kernels import front

NEIGHBOURS = 48
"""Nearest corners considered: enough on a board foreshortened four times, with false corners between its narrow
squares."""

ARM_COSINE = np.cos(np.radians(18.0))
"""Cosine of the largest angle between the chord and the arms at both ends; fisheye rows bend less within a square."""

CONTRAST_RATIO = 0.25
"""Smallest ratio of the contrasts of neighbours, also across a shadow edge."""

LENGTH_RATIO = 2.1
"""Largest ratio of the distances to opposite neighbours, in any perspective."""

EDGE_PLACES = np.array([0.5, 0.35, 0.65, 0.2, 0.8])
MIN_EDGE_PLACES = 4
"""Positions along an edge that are tested, in the order that rejects clutter soonest, and the smallest number of them
at which the expected side is dark."""

LATERAL_LENGTHS, MIN_LATERAL_PX, MAX_LATERAL_PX = 0.12, 1.0, 4.0
"""Distance from an edge at which brightness is read: a part of its length, within bounds."""


@dataclass(frozen=True, eq=False, slots=True)
class Links:
    """Mutual neighbours of N corners.

    Attributes
    ----------
    state : (N, 4) of each arm 4 * neighbour + the neighbour's arm that points back; -1 for none.
    """

    state: IntArray

    @property
    def corner(self) -> IntArray:
        """(N, 4) index of the neighbour, -1 for none."""
        return self.state >> 2

    @property
    def arm(self) -> IntArray:
        """(N, 4) the neighbour's arm that points back; 3 for none."""
        return self.state & 3


def find_links(corners: Corners, level: Level, length_ratio: float = LENGTH_RATIO) -> Links:
    """Return the mutual neighbours among `corners`; brightness is read from `level` (the finest).

    `length_ratio` : largest ratio of the distances to opposite neighbours.
    """
    count = len(corners)
    if count < 4:
        return Links(np.full((count, 4), -1))
    to = front.links(
        corners.pixels,
        line_vectors(corners.angles),
        corners.contrast,
        _bounds(corners.contrast),
        MAX_LATERAL_PX * corners.scale / level.scale,
        level.smooth,
        level.scale,
        level.offset,
        _link_rules(length_ratio),
    )
    return Links(to)


@functools.cache
def _link_rules(length_ratio: float) -> front.LinkRules:
    return front.LinkRules.of(
        neighbours=NEIGHBOURS,
        along=EDGE_PLACES,
        min_places=MIN_EDGE_PLACES,
        arm_cosine=ARM_COSINE,
        contrast_ratio=CONTRAST_RATIO,
        length_ratio=length_ratio,
        lateral=LATERAL_LENGTHS,
        min_lateral=MIN_LATERAL_PX,
    )


def _bounds(contrast: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return bounds of the contrast of possible neighbours of corners of `contrast` (N,), rounded to half octaves."""
    band = np.floor(2.0 * np.log2(np.maximum(contrast, 1e-6)))
    return CONTRAST_RATIO * 2.0 ** (0.5 * band), 2.0 ** (0.5 * (band + 1.0)) / CONTRAST_RATIO
