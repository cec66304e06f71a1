"""Which corners are neighbours along an edge of a chessboard.

Only local evidence counts, so any number of boards, any perspective and any lens will do. The two corners lie in the
direction of each other's arms, and one sees the edge rise where the other sees it fall. The brightness along the way is
dark on one side and bright on the other as the arms say.
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
"""Nearest corners looked at: enough to reach across a board that is foreshortened four times, past those that noise
adds along its narrow squares."""

ARM_COSINE = np.cos(np.radians(18.0))
"""How well the chord must follow the arms at both ends; fisheye rows bend by less within a square."""

CONTRAST_RATIO = 0.25
"""Neighbours differ less than this in contrast, also across a shadow's edge."""

LENGTH_RATIO = 2.1
"""Opposite neighbours differ less than this in distance, in any perspective a board can be read in."""

EDGE_PLACES = np.array([0.5, 0.35, 0.65, 0.2, 0.8])
MIN_EDGE_PLACES = 4
"""An edge shows the right side dark at this many of these parts of its length. Their order rejects clutter soonest."""

LATERAL_LENGTHS, MIN_LATERAL_PX, MAX_LATERAL_PX = 0.12, 1.0, 4.0
"""How far to the sides of an edge the brightness is read: a part of its length, within bounds."""


@dataclass(frozen=True, eq=False, slots=True)
class Links:
    """Mutual neighbours of N corners.

    Attributes
    ----------
    state : (N, 4) along each arm 4 * the neighbour + the arm of it that points back, -1 for none.
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
    """Return the mutual neighbours among `corners`; the brightness is read from `level` (the finest).

    `length_ratio` : most that the distances of opposite neighbours differ by.
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
    """Return the least and the most contrast of what corners of `contrast` (N,) may be linked with, by half octaves."""
    band = np.floor(2.0 * np.log2(np.maximum(contrast, 1e-6)))
    return CONTRAST_RATIO * 2.0 ** (0.5 * band), 2.0 ** (0.5 * (band + 1.0)) / CONTRAST_RATIO
