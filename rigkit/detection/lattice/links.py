"""Which corners are neighbours along an edge of a chessboard.

Only local evidence counts, so any number of boards, any perspective and any lens will do: the two corners lie in the
direction of each other's arms, one sees the edge rise where the other sees it fall, and the brightness along the way is
dark on one side and bright on the other as the arms say.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass

import numpy as np

from rigkit.core.arrays import BoolArray, FloatArray, IntArray
from rigkit.detection.saddles.response import FloatImage, Level, sample
from rigkit.detection.saddles.ring import arm_vectors
from rigkit.detection.saddles.saddle import Corners
from rigkit.kernels import front

__all__ = ["Links", "edge_contrast", "find_links", "quads"]

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

ASIDE, MIN_ASIDE_PX, MAX_ASIDE_PX = 0.12, 1.0, 4.0
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


def edge_contrast(
    image: FloatImage, start: FloatArray, end: FloatArray, sign: FloatArray, offset_px: FloatArray
) -> FloatArray:
    """Return how much brighter the expected side of the edges `start` -> `end` (M, 2) is, (M, 5) at EDGE_PLACES.

    `sign` is +1 where brightness grows with the angle (from u to v) around the start; `offset_px` (M,) is how far from
    the chord both sides are sampled.
    """
    chord = end - start
    length = np.maximum(np.linalg.norm(chord, axis=1), 1e-9)
    normal = np.stack([-chord[:, 1], chord[:, 0]], axis=1) / length[:, None]
    along = start[:, None] + EDGE_PLACES[:, None] * chord[:, None]
    aside = (sign * offset_px)[:, None, None] * normal[:, None]
    return np.asarray(sample(image, along + aside) - sample(image, along - aside), dtype=np.float64)


def find_links(corners: Corners, level: Level) -> Links:
    """Return the mutual neighbours among `corners`; the brightness is read from `level` (the finest)."""
    count = len(corners)
    if count < 4:
        return Links(np.full((count, 4), -1))
    to = _compiled(corners, level)
    return Links(_without_long(_mutual(corners, level), corners.pixels).reshape(-1, 4) if to is None else to)


def _compiled(corners: Corners, level: Level) -> IntArray | None:
    """Return the mutual links by the kernel: 4 * neighbour + its arm, (N, 4); None without it."""
    library = front.loaded()
    if library is None:
        return None
    return front.links(
        corners.pixels,
        arm_vectors(corners.angles)[:, :2],
        corners.contrast,
        _bounds(corners.contrast),
        MAX_ASIDE_PX * corners.scale / level.scale,
        level.smooth,
        level.scale,
        level.offset,
        _link_rules(),
    )


@functools.cache
def _link_rules() -> front.LinkRules:
    return front.LinkRules.make(
        NEIGHBOURS,
        EDGE_PLACES,
        MIN_EDGE_PLACES,
        arm_cosine=ARM_COSINE,
        contrast_ratio=CONTRAST_RATIO,
        length_ratio=LENGTH_RATIO,
        aside=ASIDE,
        least_aside=MIN_ASIDE_PX,
    )


def _mutual(corners: Corners, level: Level) -> IntArray:
    """Return the mutual links as above, before the long ones are dropped; flat."""
    count = len(corners)
    start, arm, end, back, distance = _candidates(corners)
    seen = _edge_seen(corners, level, start, arm, end)
    start, arm, end, back, distance = start[seen], arm[seen], end[seen], back[seen], distance[seen]
    state = 4 * start + arm
    order = np.lexsort((distance, state))
    state, first = np.unique(state[order], return_index=True)
    chosen = order[first]
    to = np.full(4 * count, -1)
    to[state] = 4 * end[chosen] + back[chosen]
    linked = np.flatnonzero(to >= 0)
    mutual = linked[to[to[linked]] == linked]
    both = np.full(4 * count, -1)
    both[mutual] = to[mutual]
    return both


def _candidates(corners: Corners) -> tuple[IntArray, IntArray, IntArray, IntArray, FloatArray]:
    """Return (start, its arm, end, its arm, distance) of the pairs whose arms point at each other."""
    pixels = corners.pixels
    length, other = _nearest_alike(pixels, corners.contrast)
    chord_u = (pixels[other, 0] - pixels[:, :1]) / length
    chord_v = (pixels[other, 1] - pixels[:, 1:]) / length
    lines = arm_vectors(corners.angles)[:, :2]
    along = [chord_u * lines[:, k, :1] + chord_v * lines[:, k, 1:] for k in (0, 1)]
    ratio = corners.contrast[:, None] / corners.contrast[other]
    alike = (ratio > CONTRAST_RATIO) & (ratio < 1.0 / CONTRAST_RATIO) & (other != np.arange(len(pixels))[:, None])
    start, slot = np.nonzero(alike & ((np.abs(along[0]) > ARM_COSINE) | (np.abs(along[1]) > ARM_COSINE)))
    end, distance = other[start, slot], length[start, slot]
    arm = _arm(along[0][start, slot], along[1][start, slot])
    chord = np.stack([chord_u[start, slot], chord_v[start, slot]], axis=-1)
    home = -(lines[end] * chord[:, None]).sum(axis=2)
    back = _arm(home[:, 0], home[:, 1])
    good = (np.abs(home).max(axis=1) > ARM_COSINE) & ((arm + back) % 2 == 1)
    return start[good], arm[good], end[good], back[good], distance[good]


def _nearest_alike(pixels: FloatArray, contrast: FloatArray) -> tuple[FloatArray, IntArray]:
    """Return distance and index of the NEIGHBOURS nearest corners of like contrast, (N, K); the corner itself fills up.

    Noise makes hundreds of faint corners: they must not crowd out the neighbours of the clear ones. So each half octave
    of contrast is looked up among those that it may be linked with.
    """
    from scipy.spatial import cKDTree

    near = min(NEIGHBOURS + 1, len(pixels))
    length = np.ones((len(pixels), near))
    other = np.repeat(np.arange(len(pixels))[:, None], near, axis=1)
    least, most = _bounds(contrast)
    for low in np.unique(least):
        mine = np.flatnonzero(least == low)
        pool = np.flatnonzero((contrast > low) & (contrast < most[mine[0]]))
        distance, found = cKDTree(pixels[pool]).query(pixels[mine], k=np.arange(1, near + 1))
        there = np.isfinite(distance)
        length[mine] = np.where(there, np.maximum(distance, 1e-6), 1.0)
        other[mine] = np.where(there, pool[np.where(there, found, 0)], mine[:, None])
    return length, other


def _bounds(contrast: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the least and the most contrast of what corners of `contrast` (N,) may be linked with, by half octaves."""
    band = np.floor(2.0 * np.log2(np.maximum(contrast, 1e-6)))
    return CONTRAST_RATIO * 2.0 ** (0.5 * band), 2.0 ** (0.5 * (band + 1.0)) / CONTRAST_RATIO


def _arm(along_a: FloatArray, along_b: FloatArray) -> IntArray:
    """Return the arm (A, B, -A, -B) that points most along, given the cosines to A and B."""
    second = np.abs(along_b) > np.abs(along_a)
    backwards = np.where(second, along_b, along_a) < 0.0
    return second.astype(np.int64) + 2 * backwards.astype(np.int64)


def _edge_seen(corners: Corners, level: Level, start: IntArray, arm: IntArray, end: IntArray) -> BoolArray:
    """Return whether the edge between the corners is there, with the polarity of the arm."""
    first, last = level.to_level(corners.pixels[start]), level.to_level(corners.pixels[end])
    length = np.linalg.norm(last - first, axis=1)
    offset = np.clip(ASIDE * length, MIN_ASIDE_PX, MAX_ASIDE_PX * corners.scale[start] / level.scale)
    sign = np.where(arm % 2 == 0, 1.0, -1.0)
    difference = edge_contrast(level.smooth, first, last, sign, offset)
    weakest = CONTRAST_RATIO * np.minimum(corners.contrast[start], corners.contrast[end])
    return np.asarray((difference > weakest[:, None]).sum(axis=1) >= MIN_EDGE_PLACES, dtype=np.bool_)


def _without_long(to: IntArray, pixels: FloatArray) -> IntArray:
    """Drop links more than LENGTH_RATIO times as long as the link of the opposite arm."""
    there = to >= 0
    length = np.where(
        there, np.linalg.norm(pixels[np.where(there, to, 0) // 4] - np.repeat(pixels, 4, axis=0), axis=1), 0
    )
    opposite = np.roll(length.reshape(-1, 4), 2, axis=1).ravel()
    drop = there & (opposite > 0) & (length > LENGTH_RATIO * opposite)
    out = to.copy()
    out[to[drop]] = -1
    out[drop] = -1
    return out


def quads(links: Links) -> BoolArray:
    """Return which links (N, 4) bound a closed square of four corners, on either side."""
    count = len(links.state)
    there = links.state >= 0
    state = links.state.ravel()
    turned = np.where(there, 4 * links.corner + (links.arm - 1) % 4, -1).ravel()
    start = np.arange(4 * count)
    walk = start
    for _ in range(4):
        walk = np.where(walk >= 0, turned[walk], -1)
    closed = (walk == start) & there.ravel()
    other = np.zeros_like(closed)
    other[state[closed]] = True
    return np.asarray((closed | other).reshape(-1, 4), dtype=np.bool_)
