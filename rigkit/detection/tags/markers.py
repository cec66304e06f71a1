"""Reading markers of any dictionary in one image: quadrilaterals are detected once, and sampled once for each number of
modules that markers have."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from rigkit.core.arrays import FloatArray, IntArray
from rigkit.core.patterns.aprilgrid import AprilGrid
from rigkit.core.patterns.aruco import marker_count
from rigkit.detection.saddles.response import GreyImage
from rigkit.detection.tags.codes import MIN_CODE_CONTRAST, Codes
from rigkit.detection.tags.quads import quadrilaterals
from rigkit.kernels.surface import read_modules

MIN_DARK_BORDER = 0.65
"""Smallest share of the modules of a marker's border that are darker than the middle between its darkest and brightest
module. It is OpenCV's limit, so that few squares are compared with thousands of markers."""

MIN_MARKER_LIKENESS, MIN_MARKER_MARGIN = 0.85, 0.02
"""Smallest correlation of a marker with its code, and smallest difference to that with any other marker. The smallest
correlation of markers that OpenCV reads in REAL images, reduced by up to 4 and blurred by up to 4 px, is 0.88; a square
with 16 random bits is within one bit of some of 1000 markers, 0.93, but of several."""


@dataclass(frozen=True, eq=False, slots=True)
class ReadMarkers:
    """N markers of one dictionary, all with different numbers.

    Attributes
    ----------
    corners : (N, 4, 2) from the upright marker's first one, in the order of increasing angle from u to v.
    numbers : (N,)
    likeness : (N,) correlation with their codes.
    """

    corners: FloatArray
    numbers: IntArray
    likeness: FloatArray


def read_markers(image: GreyImage, dictionaries: Sequence[str]) -> dict[str, ReadMarkers]:
    """Return the markers in an image by dictionary, without dictionaries that have none."""
    quads = quadrilaterals(image)
    by_side: dict[int, list[tuple[str, Codes]]] = {}
    for name in dictionaries:
        codes = Codes.of(AprilGrid(1.0, name, 1, numbering="opencv"), np.arange(marker_count(name)))
        by_side.setdefault(codes.modules, []).append((name, codes))
    out = {}
    for side, kinds in by_side.items():
        own, bright = _framed(image, quads, side)
        for name, codes in kinds:
            found = _of_kind(own, bright, codes)
            if len(found.numbers):
                out[name] = found
    return out


def _framed(image: GreyImage, quads: FloatArray, side: int) -> tuple[FloatArray, FloatArray]:
    """Return the quads (N, 4, 2) with dark borders, and the brightness of their modules (N, side^2), of mean 0 and
    length 1."""
    if not len(quads):
        return quads, np.zeros((0, side * side))
    bright, spread = read_modules(image, quads, side)
    edge = np.ones((side, side), np.bool_)
    edge[1:-1, 1:-1] = False
    middle = 0.5 * (bright.min(axis=1) + bright.max(axis=1))
    dark = (bright[:, edge.ravel()] < middle[:, None]).mean(axis=1)
    good = (dark >= MIN_DARK_BORDER) & (spread >= MIN_CODE_CONTRAST)
    return quads[good], bright[good]


def _of_kind(quads: FloatArray, bright: FloatArray, codes: Codes) -> ReadMarkers:
    """Return the markers of a dictionary in the quads (N, 4, 2), the most similar one for each number."""
    every = np.arange(len(quads))
    likeness = bright @ codes.patterns.T
    best = likeness.argmax(axis=1) if len(quads) else np.zeros(0, np.int64)
    most, number, turns = likeness[every, best], codes.numbers[best], codes.turns[best]
    likeness[codes.numbers == number[:, None]] = -1.0
    good = (most >= MIN_MARKER_LIKENESS) & (most - likeness.max(axis=1, initial=-1.0) >= MIN_MARKER_MARGIN)
    order = np.flatnonzero(good)[np.argsort(-most[good], kind="stable")]
    own = order[np.unique(number[order], return_index=True)[1]]
    corners = quads[own[:, None], (turns[own, None] + np.arange(4)) % 4]
    return ReadMarkers(corners, number[own], most[own])
