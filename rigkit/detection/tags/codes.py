"""Reading the code of a tag whose four corners are known.

The brightness at the middle of every module is compared with that of every tag that may be there, in its four
orientations, by correlation: no threshold, so that slanted light, blur and low contrast cost little. Borders count like
bits: a black square without a code is no tag.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np

from rigkit.core.arrays import BoolArray, FloatArray, IntArray
from rigkit.core.patterns.aprilgrid import AprilGrid
from rigkit.detection.saddles.response import GreyImage
from rigkit.kernels.surface import read_codes, read_modules

MIN_LIKENESS = 0.7
"""Correlation of a tag with its code at least. Of a code of 36 bits, bits at random reach 0.7 with one of 600 tags once
in some thousand squares; blur as wide as a module still leaves 0.8."""

MIN_PREDICTED_LIKENESS = 0.6
"""The same where one tag is foretold and no other, nor this one turned, is more like what is seen: tags of 1.2 px a
module at the rim of a fisheye, blurred by 0.7 px, have 0.63 and others 0.5 there (RENDERED)."""

MIN_CODE_CONTRAST = 1.5
"""Standard deviation of the modules' brightness, grey levels: less is paper, or a black square. Ink ten levels
darker than paper makes 4."""

MIN_SCATTER = 1e-6
"""Correlations that scatter less are all the same: rounding."""


@dataclass(frozen=True, eq=False, slots=True)
class Codes:
    """What the tags that may be there look like.

    Attributes
    ----------
    modules : on a side, with the border.
    numbers : (4 N,) tag of each code.
    turns : (4 N,) quarter turns, with the angle growing from right to down, by which the code is turned.
    patterns : (4 N, modules^2) brightness, of mean 0 and length 1.
    """

    modules: int
    numbers: IntArray
    turns: IntArray
    patterns: FloatArray

    @classmethod
    def of(cls, pattern: AprilGrid, numbers: IntArray) -> Codes:
        """Return the codes of the tags of these numbers."""
        return _codes(pattern.dictionary, pattern.border, pattern.numbering, tuple(numbers.tolist()))


@cache
def _codes(dictionary: str, border: int, numbering: str, numbers: tuple[int, ...]) -> Codes:
    own = AprilGrid(1.0, dictionary, border, numbering=numbering).modules()[list(numbers)]
    turned = [np.rot90(own, -turns, axes=(1, 2)) for turns in range(4)]
    bright = 1.0 - np.stack(turned, axis=1).reshape(4 * len(own), -1).astype(np.float64)
    bright -= bright.mean(axis=1, keepdims=True)
    bright /= np.linalg.norm(bright, axis=1, keepdims=True)
    return Codes(own.shape[1], np.repeat(np.array(numbers), 4), np.tile(np.arange(4), len(own)), bright)


@dataclass(frozen=True, eq=False, slots=True)
class TagCode:
    """What was read in N quadrilaterals.

    Attributes
    ----------
    number : (N,) tag that it is most like.
    turns : (N,) quarter turns by which the tag is turned against the quadrilateral's first corner.
    likeness : (N,) correlation, 0 where there is nothing to read.
    """

    number: IntArray
    turns: IntArray
    likeness: FloatArray

    @property
    def read(self) -> BoolArray:
        return self.likeness >= MIN_LIKENESS


def read_tags(image: GreyImage, quads: FloatArray, codes: Codes) -> TagCode:
    """Return the codes in the quadrilaterals (N, 4, 2), corners in order of growing angle from u to v."""
    if not len(quads):
        return TagCode(np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros(0))
    best, most = read_codes(image, quads, codes.modules, codes.patterns, MIN_CODE_CONTRAST)
    return TagCode(codes.numbers[best], codes.turns[best], most)


def excess_likeness(image: GreyImage, quads: FloatArray, codes: Codes) -> FloatArray:
    """Return how much more each code is like a quadrilateral (N, 4, 2) than codes are on average, in their scatter: (N,
    4 T) for each code of `codes`; 0 where there is nothing to read."""
    bright, spread = read_modules(image, quads, codes.modules)
    likeness = bright @ codes.patterns.T
    excess = likeness - likeness.mean(axis=1, keepdims=True)
    scatter = np.maximum(excess.std(axis=1, keepdims=True), MIN_SCATTER)
    return np.asarray(np.where(spread[:, None] < MIN_CODE_CONTRAST, 0.0, excess / scatter))


def transferred(homography: FloatArray, points: FloatArray) -> FloatArray:
    """Return points (P, 2) under every homography (N, 3, 3), as (N, P, 2)."""
    image = np.concatenate([points, np.ones((len(points), 1))], axis=1) @ np.swapaxes(homography, 1, 2)
    return np.asarray(image[..., :2] / image[..., 2:])
