"""Calls of the kernels in looks.c, smoothing.c, peaks.c, corners.c and links.c: plain arrays; tolerances are the
callers'."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rigkit.core.arrays import BoolArray, FloatArray, GreyImage, IntArray
from rigkit.kernels import kernels
from rigkit.kernels.calls import Struct, structure
from rigkit.kernels.declarations import header

_CONSTANTS = header().constants
STRIP, STRIP_ROWS, STRIPS_FROM, HALF = (_CONSTANTS[name] for name in ("STRIP", "STRIP_ROWS", "STRIPS_FROM", "HALF"))

WHOLE = 16.0
"""A kernel of multiples of 1/16 smooths bytes exactly in integers of 16 bits."""

MAX_SUMMED = 256
"""Bytes whose sum fits 16 bits."""

Image = NDArray[np.float32]


@structure("level_rules_t")
class LevelRules(Struct):
    """How levels are smoothed, and what their thresholds follow from."""

    @classmethod
    def make(cls, kernel: Image, **numbers: float) -> LevelRules:
        """Return the rules; `kernel` (5,) is symmetric, of multiples of 1/WHOLE."""
        return cls.of(kernel=np.ascontiguousarray(kernel, np.float32), whole=WHOLE, **numbers)


@structure("ring_rules_t")
class RingRules(Struct):
    """How rings are read."""


@structure("link_rules_t")
class LinkRules(Struct):
    """How links are found."""


@structure("image_t")
class ImageOf(Struct):
    """An image of brightness, float32."""


@structure("corners_t")
class _CornerArrays(Struct):
    """The corners that links are sought for."""


def has_mosaic(image: GreyImage, step: int, min_level: float, share: float) -> bool:
    """Return whether a place in squares of 2 x 2 pixels is brighter or darker than the mean of its square by `share` of
    that. It is so in the upper median over the squares, of every `step`-th both ways, that are brighter than the upper
    median of all, and than `min_level`."""
    return bool(kernels().has_mosaic(image, step, min_level, share))


def bad_pixels(image: GreyImage, first: int, apart: int, step: float, share: float) -> tuple[int, float]:
    """Return how many inner pixels of every `apart`-th row from the `first` on stand out of all of their neighbours by
    more than `step` and by more than `share` of the range of brightness in these rows; and that range."""
    count, span = kernels().count_bad_pixels(image, first, apart, step, share)
    return count, float(span[0])


def shrunk(image: GreyImage, factor: int) -> Image:
    """Return the means of `factor` x `factor` pixels."""
    if image.dtype == np.uint8 and factor <= MAX_SUMMED:
        return np.asarray(kernels().shrink_bytes(image, factor))
    return np.asarray(kernels().shrink_floats(image.astype(np.float32, copy=False), factor))


def level(image: GreyImage, rules: LevelRules, step: int) -> tuple[Image, Image, Image]:
    """Return `image` smoothed, every second of its pixels both ways, and the smallest response of a peak in each STRIP
    pixels of STRIP_ROWS rows: as the light there, and every `step`-th inner pixel both ways, have it."""
    height, width = image.shape
    half_height, half_width = (height + 1) // 2, (width + 1) // 2
    # One block of memory: the allocator keeps it for the next image, as it would not two.
    block = np.empty(height * width + half_height * half_width, np.float32)
    smooth, half = block[: height * width].reshape(height, width), block[height * width :].reshape(-1, half_width)
    return smooth, half, kernels().make_level(image, step, rules, smooth, half)


def peaks(smooth: Image, above: Image, limit: int, side: int, finest: int) -> tuple[NDArray[np.int32], Image]:
    """Return (u, v) and response of the peaks above their thresholds (`level`), row by row.

    Of more than `limit` peaks, about so many are kept: those strongest beside the strongest in their square of `side`
    pixels, to one part in `finest`.
    """
    height, width = smooth.shape
    found, at, response = kernels().find_peaks(smooth, above)
    at, response = at[:found], response[:found]
    if found > limit:
        squares = np.zeros((height // side + 1) * (width // side + 1), np.float32)
        bins = np.zeros(finest + 1, np.int32)
        found = kernels().keep_strongest(at, response, height, width, side, limit, finest, squares, bins)
    return at[:found], response[:found]


class CornersOfLevel(NamedTuple):
    """What lies next to the peaks of a level, in pixels of the full image.

    Attributes
    ----------
    saddles : (N, 2)
    pixels, angles, contrast : (M, 2), (M, 2) and (M,), of the corners among these.
    smeared : (M,) only motion explains their middle.
    repeated : (M,) there is a known one nearby.
    """

    saddles: FloatArray
    pixels: FloatArray
    angles: FloatArray
    contrast: FloatArray
    smeared: BoolArray
    repeated: BoolArray


def corners(
    smooth: Image,
    at: NDArray[np.signedinteger],
    response: Image,
    tests: tuple[float, float, float],
    rules: RingRules,
    to_full: tuple[float, float],
    known: FloatArray,
    reach: float,
) -> CornersOfLevel:
    """Return what lies next to the peaks `at` (P, 2) of a level.

    Parameters
    ----------
    tests : radius of the rings, largest step to a saddle, largest response relative to the square of the contrast.
    to_full : scale and offset of the level.
    known : (K, 2) corners that are known; one within `reach` of these is repeated.
    """
    at, response = np.ascontiguousarray(at, np.int32), np.ascontiguousarray(response, np.float32)
    done, saddles, *of_corners, found = kernels().find_corners(
        smooth, at, response, *tests, rules, *to_full, known, reach
    )
    if not done:
        raise MemoryError
    near, good = found.tolist()
    return CornersOfLevel(saddles[:near], *(values[:good] for values in of_corners))


def near_any(fresh: FloatArray, known: FloatArray, reach: float) -> BoolArray:
    """Return which of `fresh` (N, 2) lie within `reach` of any of `known` (M, 2)."""
    if not len(fresh) or not len(known):
        return np.zeros(len(fresh), np.bool_)
    done, mark = kernels().mark_known(fresh, known, reach)
    if not done:
        raise MemoryError
    return np.asarray(mark)


def links(
    pixels: FloatArray,
    lines: FloatArray,
    contrast: FloatArray,
    bounds: tuple[FloatArray, FloatArray],
    reach: FloatArray,
    image: Image,
    scale: float,
    offset: float,
    rules: LinkRules,
) -> IntArray:
    """Return the mutual neighbours of N corners, (N, 4): 4 * the neighbour + its arm, -1 for none.

    `lines` (N, 2, 2) are the unit vectors of A and B, `bounds` the contrasts (N,) of those looked at, `reach` (N,) the
    largest distance of the places that are looked at from the edge.
    """
    min_contrast, max_contrast = bounds
    given = _CornerArrays.of(
        pixels=pixels, lines=lines, contrast=contrast, min_contrast=min_contrast, max_contrast=max_contrast, reach=reach
    )
    done, both = kernels().find_links(given, ImageOf.of(brightness=image), scale, offset, rules)
    if not done:
        raise MemoryError
    return np.asarray(both)
