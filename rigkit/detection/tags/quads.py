"""Lone tags: dark quadrilaterals are detected and identified by their codes; a tag that contradicts the places of the
others is dropped."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from rigkit.core.arrays import BoolArray, FloatArray, IntArray
from rigkit.detection.saddles.response import GreyImage, as_bytes
from rigkit.detection.tags.codes import read_tags, transferred
from rigkit.detection.tags.placing import MIN_BITS, TagBoard
from rigkit.kernels.surface import maps_of_quads

MIN_PERIMETER, MIN_OUTLINE_PX = 0.015, 12
"""Smallest length of a quadrilateral's outline, in widths of the image (tags of 8 px in 2000), and in pixels."""

THRESHOLD_SIDES, DARKER_THAN_MEAN = (3, 13, 23), 7.0
"""Sides of the squares, px, over whose means ink is darker by this many grey levels: the smallest one separates what
almost touches, the largest one closes blurred borders."""

AROUND_PIXEL = np.array([[1, 1, 1], [1, 0, 1], [1, 1, 1]], np.uint8)

OFF_OUTLINE, MIN_SIDE_OF_OUTLINE, MIN_BORDER_PX = 0.03, 0.05, 3
"""Largest deviation of an outline from the polygon of its four corners, and smallest side of that polygon, in lengths
of the outline; and smallest distance of the corners from the border of the image."""

NEAR_PLACE, AGREEING_OTHERS = 0.25, 0.4
"""Largest error of the relative position of two tags that agree, in their distance, as lenses distort; and smallest
share of the others with which a tag agrees: a misread code agrees with none."""


def placed_tags(image: GreyImage, board: TagBoard) -> FloatArray:
    """Return the approximate corners (R, C, 2) of the tags of `board` in an image, NaN where not found."""
    columns, rows = board.board.size
    pixels = np.full((rows, columns, 2), np.nan)
    quads = quadrilaterals(image)
    tags = read_tags(image, quads, board.codes)
    # The same tag is found several times: at the outer and at the inner border.
    order = np.flatnonzero(tags.read)[np.argsort(-tags.likeness[tags.read], kind="stable")]
    _, first = np.unique(tags.number[order], return_index=True)
    own = order[first]
    if not len(own):
        return pixels
    turned = (tags.turns[own, None] + np.arange(4)) % 4
    corners = quads[own[:, None], turned]
    place = board.firsts[tags.number[own]]
    kept = _agreeing(corners, place, 1.0 + board.pattern.spacing)
    if np.count_nonzero(kept) * (board.codes.modules - 2 * board.pattern.border) ** 2 < MIN_BITS:
        return pixels
    for k, (right, down) in enumerate(((0, 0), (1, 0), (1, 1), (0, 1))):
        pixels[place[kept, 1] + down, place[kept, 0] + right] = corners[kept, k]
    return pixels


def quadrilaterals(image: GreyImage) -> FloatArray:
    """Return quadrilaterals (N, 4, 2) that may be tags, corners in the order of increasing angle from u to v.

    They are the outlines with four corners of regions darker than the mean over squares of several sizes, as in
    Garrido-Jurado et al., "Automatic generation and detection of highly reliable fiducial markers under occlusion",
    Pattern Recognition 47 (2014), section 4.1. cv2.aruco spends four fifths of its time on reading them, too, and
    supports neither wide borders nor more than one dictionary.
    """
    grey = as_bytes(image)
    fewest = max(MIN_PERIMETER * max(grey.shape), MIN_OUTLINE_PX)
    found: list[NDArray[np.integer[Any] | np.floating[Any]]] = []
    lengths: list[int] = []
    for side in THRESHOLD_SIDES:
        dark = cv2.adaptiveThreshold(
            grey, 255, cv2.ADAPTIVE_THRESH_MEAN_C, cv2.THRESH_BINARY_INV, side, DARKER_THAN_MEAN
        )
        # Lone pixels are no tags, but up to half of all outlines, which take most of the time, long or short.
        connected = cv2.bitwise_and(dark, cv2.dilate(dark, AROUND_PIXEL))
        outlines, _ = cv2.findContours(connected, cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)
        for outline in outlines:
            if len(outline) < fewest:
                continue
            shape = cv2.approxPolyDP(outline, OFF_OUTLINE * len(outline), True)
            if len(shape) == 4:
                found.append(shape[:, 0])
                lengths.append(len(outline))
    if not found:
        return np.zeros((0, 4, 2))
    return _outwards(_proper(np.array(found, np.float64), np.array(lengths), grey.shape))


def _proper(quads: FloatArray, lengths: IntArray, shape: tuple[int, ...]) -> FloatArray:
    """Return the convex quads (N, 4, 2), in order of increasing angle, whose sides are long enough relative to the
    `lengths` (N,) of their outlines, and which the border of the image does not cut."""
    side = np.roll(quads, -1, axis=1) - quads
    after = np.roll(side, -1, axis=1)
    turn = side[..., 0] * after[..., 1] - side[..., 1] * after[..., 0]
    good = (turn > 0.0).all(axis=1) | (turn < 0.0).all(axis=1)
    good &= np.linalg.norm(side, axis=2).min(axis=1) >= MIN_SIDE_OF_OUTLINE * lengths
    last = np.array(shape[1::-1]) - 1.0
    good &= ((quads >= MIN_BORDER_PX) & (quads <= last - MIN_BORDER_PX)).all(axis=(1, 2))
    quads, backwards = quads[good], turn[good, 0] < 0.0
    return np.where(backwards[:, None, None], quads[:, ::-1], quads)


def _outwards(quads: FloatArray) -> FloatArray:
    """Return the quads (N, 4, 2) moved to the edges: outlines run through the middles of the outermost dark pixels,
    half a pixel inside."""
    away = [quads - np.roll(quads, sign, axis=1) for sign in (1, -1)]
    lengths = [np.maximum(np.linalg.norm(side, axis=2, keepdims=True), 1e-9) for side in away]
    return np.asarray(quads + 0.5 * (away[0] / lengths[0] + away[1] / lengths[1]))


def _agreeing(corners: FloatArray, place: IntArray, step: float) -> BoolArray:
    """Return which tags with `corners` (N, 4, 2) and first corners `place` (N, 2) on the board agree with the others.

    `step` is the distance from tag to tag, in sides of a tag.
    """
    tag = 0.5 * step * place + 0.5
    middle = corners.mean(axis=1)
    inverse = np.asarray(np.linalg.inv(maps_of_quads(corners)), np.float64)
    # Positions of the others (second index) seen from each tag, in its sides from its first corner, and as printed.
    has = np.stack([transferred(inverse[k : k + 1], middle)[0] for k in range(len(middle))])
    should = tag - tag[:, None] + 0.5
    sign = np.linalg.norm(tag - tag[:, None], axis=2)
    near = np.linalg.norm(has - should, axis=2) < NEAR_PLACE * np.maximum(sign, step)
    others = max(len(tag) - 1, 1)
    return np.asarray((np.count_nonzero(near, axis=0) - 1 >= AGREEING_OTHERS * others) | (len(tag) == 1))
