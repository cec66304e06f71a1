"""Reading markers of any dictionary in one image: squares are outlined once, and each is read once for every number of
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
"""Of the modules of a marker's border, this part at least is darker than the middle between its darkest and its
brightest module: as much as OpenCV asks, so that few squares are compared with thousands of markers."""

MIN_MARKER_LIKENESS, MIN_MARKER_MARGIN = 0.85, 0.02
"""Correlation of a marker with its code at least, and by how much that of any other marker is less. Of what OpenCV
reads in REAL pictures, made smaller by up to 4 and blurred by up to 4 px, the least has 0.88; a square whose 16 bits
are chance is within one bit of some of 1000 markers, 0.93, but of several."""


@dataclass(frozen=True, eq=False, slots=True)
class ReadMarkers:
    """N markers of one dictionary, each number once.

    Attributes
    ----------
    corners : (N, 4, 2) as the marker stands upright, in order of growing angle from u to v.
    numbers : (N,)
    likeness : (N,) correlation with their codes.
    """

    corners: FloatArray
    numbers: IntArray
    likeness: FloatArray


def read_markers(image: GreyImage, dictionaries: Sequence[str]) -> dict[str, ReadMarkers]:
    """Return the markers that are seen in an image, by dictionary, those left out of which there are none."""
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
    """Return those of the quads (N, 4, 2) that have dark borders, and the brightness of their modules (N, side^2), of
    mean 0 and length 1."""
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
    """Return the markers of a dictionary that quads (N, 4, 2) are, of each number the one most like it."""
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
