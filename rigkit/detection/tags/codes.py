"""Reading the code of a tag whose four corners are known.

The brightness at the middles of the modules is correlated with all possible tags in their four orientations. There is
no threshold of brightness, so that uneven light, blur and low contrast have little effect. Modules of the border count
like bits: a black square without a code is no tag.
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
"""Smallest correlation of a tag with its code. With 36 bits, random bits reach 0.7 with one of 600 tags once in some
thousand squares; blur as wide as a module still leaves 0.8."""

MIN_PREDICTED_LIKENESS = 0.6
"""The same for a predicted tag, if no other tag or orientation has a larger correlation: tags of 1.2 px a module at the
rim of a fisheye, blurred by 0.7 px, have 0.63 there, and others 0.5 (RENDERED)."""

MIN_CODE_CONTRAST = 1.5
"""Smallest standard deviation of the modules' brightness, in grey levels: paper or a black square has less, ink ten
levels darker than paper makes 4."""

MIN_SCATTER = 1e-6
"""Smallest standard deviation of correlations: smaller ones are due to rounding."""


@dataclass(frozen=True, eq=False, slots=True)
class Codes:
    """The codes of the tags that may be in an image.

    Attributes
    ----------
    modules : number of modules along a side, with the border.
    numbers : (4 N,) tag of each code.
    turns : (4 N,) rotation of the code in quarter turns, in the direction from right to down.
    patterns : (4 N, modules^2) brightness, of mean 0 and length 1.
    """

    modules: int
    numbers: IntArray
    turns: IntArray
    patterns: FloatArray

    @classmethod
    def of(cls, pattern: AprilGrid, numbers: IntArray) -> Codes:
        """Return the codes of the tags with these numbers."""
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
    """The codes read in N quadrilaterals.

    Attributes
    ----------
    number : (N,) tag with the largest correlation.
    turns : (N,) rotation of the tag relative to the quadrilateral's first corner, in quarter turns.
    likeness : (N,) correlation, 0 if the contrast is too low.
    """

    number: IntArray
    turns: IntArray
    likeness: FloatArray

    @property
    def read(self) -> BoolArray:
        return self.likeness >= MIN_LIKENESS


def read_tags(image: GreyImage, quads: FloatArray, codes: Codes) -> TagCode:
    """Return the codes in the quadrilaterals (N, 4, 2), corners in the order of increasing angle from u to v."""
    if not len(quads):
        return TagCode(np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros(0))
    best, most = read_codes(image, quads, codes.modules, codes.patterns, MIN_CODE_CONTRAST)
    return TagCode(codes.numbers[best], codes.turns[best], most)


def excess_likeness(image: GreyImage, quads: FloatArray, codes: Codes) -> FloatArray:
    """Return the correlations (N, 4 T) of N quadrilaterals (N, 4, 2) with all codes, minus their mean over the codes,
    in their standard deviations; 0 if the contrast is too low."""
    bright, spread = read_modules(image, quads, codes.modules)
    likeness = bright @ codes.patterns.T
    excess = likeness - likeness.mean(axis=1, keepdims=True)
    scatter = np.maximum(excess.std(axis=1, keepdims=True), MIN_SCATTER)
    return np.asarray(np.where(spread[:, None] < MIN_CODE_CONTRAST, 0.0, excess / scatter))


def transferred(homography: FloatArray, points: FloatArray) -> FloatArray:
    """Return points (P, 2) mapped by each homography (N, 3, 3), (N, P, 2)."""
    image = np.concatenate([points, np.ones((len(points), 1))], axis=1) @ np.swapaxes(homography, 1, 2)
    return np.asarray(image[..., :2] / image[..., 2:])
