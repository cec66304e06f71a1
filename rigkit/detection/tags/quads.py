"""Tags that stand alone: OpenCV finds dark quadrilaterals, their codes identify them, and a tag that does not lie where
the others have it is dropped."""

from __future__ import annotations

import cv2
import numpy as np

from rigkit.core.arrays import BoolArray, FloatArray, IntArray
from rigkit.detection.saddles.response import GreyImage
from rigkit.detection.tags.codes import homographies, read_tags, transferred
from rigkit.detection.tags.placing import MIN_BITS, TagBoard

MIN_PERIMETER = 0.015
"""Of a quadrilateral, in widths of the image: tags of 8 px in 2000."""

NEAR_PLACE, AGREEING_OTHERS = 0.25, 0.4
"""Two tags agree where they lie to each other as on the board, within this part of their distance, for lenses distort;
a tag is kept where this part of the others agree with it: a code read by chance agrees with none."""


def placed_tags(image: GreyImage, board: TagBoard) -> FloatArray:
    """Return the rough corners (R, C, 2) of the tags of `board` in an image, NaN where none is seen."""
    columns, rows = board.board.size
    pixels = np.full((rows, columns, 2), np.nan)
    quads = quadrilaterals(image)
    tags = read_tags(image, quads, board.codes)
    # The same tag is seen several times: at the outer and at the inner border.
    order = np.flatnonzero(tags.read)[np.argsort(-tags.likeness[tags.read], kind="stable")]
    _, first = np.unique(tags.number[order], return_index=True)
    own = order[first]
    if not len(own):
        return pixels
    turned = (tags.turns[own, None] + np.arange(4)) % 4
    corners = quads[own[:, None], turned]
    place = board.corner_of(tags.number[own])
    kept = _agreeing(corners, place, 1.0 + board.pattern.spacing)
    if np.count_nonzero(kept) * (board.codes.modules - 2 * board.pattern.border) ** 2 < MIN_BITS:
        return pixels
    for k, (right, down) in enumerate(((0, 0), (1, 0), (1, 1), (0, 1))):
        pixels[place[kept, 1] + down, place[kept, 0] + right] = corners[kept, k]
    return pixels


def quadrilaterals(image: GreyImage) -> FloatArray:
    """Return quadrilaterals (N, 4, 2) of an image that may be tags, corners in order of growing angle from u to v."""
    grey = image if image.dtype == np.uint8 else np.clip(np.rint(image), 0, 255).astype(np.uint8)
    parameters = cv2.aruco.DetectorParameters()
    parameters.minMarkerPerimeterRate = MIN_PERIMETER
    # Which markers OpenCV takes them for does not matter: it cannot read wide borders.
    detector = cv2.aruco.ArucoDetector(cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50), parameters)
    seen, _, others = detector.detectMarkers(grey)
    every = [*(seen or ()), *(others or ())]
    if not every:
        return np.zeros((0, 4, 2))
    quads = np.array(every, dtype=np.float64).reshape(-1, 4, 2)
    one, other = quads[:, 2] - quads[:, 0], quads[:, 3] - quads[:, 1]
    backwards = one[:, 0] * other[:, 1] - one[:, 1] * other[:, 0] < 0.0
    quads = np.where(backwards[:, None, None], quads[:, ::-1], quads)
    # Contours run through the middles of the outermost dark pixels, half a pixel inside the edge.
    away = [quads - np.roll(quads, way, axis=1) for way in (1, -1)]
    lengths = [np.maximum(np.linalg.norm(side, axis=2, keepdims=True), 1e-9) for side in away]
    return np.asarray(quads + 0.5 * (away[0] / lengths[0] + away[1] / lengths[1]))


def _agreeing(corners: FloatArray, place: IntArray, step: float) -> BoolArray:
    """Return which tags with `corners` (N, 4, 2) and first corners `place` (N, 2) of the board lie where others say.

    `step` is from tag to tag, in sides of a tag.
    """
    tag = 0.5 * step * place + 0.5
    middle = corners.mean(axis=1)
    inverse = np.asarray(np.linalg.inv(homographies(corners)), np.float64)
    # Where each tag (first index) has the others, in its own sides from its own first corner, and where it should.
    has = np.stack([transferred(inverse[k : k + 1], middle)[0] for k in range(len(middle))])
    should = tag - tag[:, None] + 0.5
    way = np.linalg.norm(tag - tag[:, None], axis=2)
    near = np.linalg.norm(has - should, axis=2) < NEAR_PLACE * np.maximum(way, step)
    others = max(len(tag) - 1, 1)
    return np.asarray((np.count_nonzero(near, axis=0) - 1 >= AGREEING_OTHERS * others) | (len(tag) == 1))
