"""What the detector asks the kernel of links.c for, in numpy, with the same arguments; the tolerances are its own."""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from rigkit.core.arrays import BoolArray, FloatArray, IntArray
from rigkit.detection.lattice.links import (
    ARM_COSINE,
    CONTRAST_RATIO,
    EDGE_PLACES,
    LATERAL_LENGTHS,
    LENGTH_RATIO,
    MAX_LATERAL_PX,
    MIN_EDGE_PLACES,
    MIN_LATERAL_PX,
    NEIGHBOURS,
    Links,
    _bounds,
)
from rigkit.detection.saddles.response import FloatImage, Level, sample
from rigkit.detection.saddles.ring import line_vectors
from rigkit.detection.saddles.saddle import Corners
from rigkit.kernels.front import LinkRules

NO_THRESHOLDS = np.zeros((0, 0), np.float32)
"""Of a level whose peaks nobody asks for."""


def links(
    pixels: FloatArray,
    lines: FloatArray,
    contrast: FloatArray,
    bounds: tuple[FloatArray, FloatArray],
    reach: FloatArray,
    image: FloatImage,
    scale: float,
    offset: float,
    rules: LinkRules,
) -> IntArray:
    assert np.array_equal(bounds, _bounds(contrast)) and rules.neighbours == NEIGHBOURS
    angles = np.arctan2(lines[..., 1], lines[..., 0])
    given = Corners(pixels, angles, contrast, reach * scale / MAX_LATERAL_PX)
    return _without_long(_mutual(given, Level(image, NO_THRESHOLDS, scale, offset)), pixels).reshape(-1, 4)


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
    lateral = (sign * offset_px)[:, None, None] * normal[:, None]
    return np.asarray(sample(image, along + lateral) - sample(image, along - lateral), dtype=np.float64)


def _mutual(corners: Corners, level: Level) -> IntArray:
    """Return the mutual links, 4 * the neighbour + its arm, before the long ones are dropped; flat."""
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
    lines = line_vectors(corners.angles)
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


def _arm(along_a: FloatArray, along_b: FloatArray) -> IntArray:
    """Return the arm (A, B, -A, -B) that points most along, given the cosines to A and B."""
    second = np.abs(along_b) > np.abs(along_a)
    backwards = np.where(second, along_b, along_a) < 0.0
    return second.astype(np.int64) + 2 * backwards.astype(np.int64)


def to_level(level: Level, pixels: FloatArray) -> FloatArray:
    """Return full-resolution `pixels` in pixels of the level."""
    return (pixels - level.offset) / level.scale


def _edge_seen(corners: Corners, level: Level, start: IntArray, arm: IntArray, end: IntArray) -> BoolArray:
    """Return whether the edge between the corners is there, with the polarity of the arm."""
    first, last = to_level(level, corners.pixels[start]), to_level(level, corners.pixels[end])
    length = np.linalg.norm(last - first, axis=1)
    offset = np.clip(LATERAL_LENGTHS * length, MIN_LATERAL_PX, MAX_LATERAL_PX * corners.scale[start] / level.scale)
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
