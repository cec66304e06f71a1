"""Calls of the kernels in looks.c, smoothing.c, peaks.c, corners.c and links.c, with the callers' tolerances."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rigkit.core.arrays import BoolArray, FloatArray, GreyImage, IntArray
from rigkit.kernels import kernels
from rigkit.kernels.calls import Struct, make_struct, structure
from rigkit.kernels.declarations import header

_CONSTANTS = header().constants
STRIP, STRIP_ROWS, STRIPS_FROM, HALF = (_CONSTANTS[name] for name in ("STRIP", "STRIP_ROWS", "STRIPS_FROM", "HALF"))

WHOLE = 16.0
"""Denominator of the smoothing kernel, with which bytes are smoothed exactly in 16-bit integers."""

MAX_SUMMED = 256
"""Largest number of bytes whose sum fits 16 bits."""

Image = NDArray[np.float32]


@structure("level_rules_t")
class LevelRules(Struct):
    """Parameters of the smoothing of levels and of their thresholds."""

    @classmethod
    def make(cls, kernel: Image, **numbers: float) -> LevelRules:
        """Return the rules; `kernel` (5,) is symmetric, of multiples of 1/WHOLE."""
        return cls.of(kernel=np.ascontiguousarray(kernel, np.float32), whole=WHOLE, **numbers)


@structure("ring_rules_t")
class RingRules(Struct):
    """Parameters of the ring test."""


@structure("link_rules_t")
class LinkRules(Struct):
    """Parameters of the search for links."""


@structure("image_t")
class ImageOf(Struct):
    """An image of brightness, float32."""


def has_mosaic(image: GreyImage, step: int, min_level: float, share: float) -> bool:
    """Return whether a position in cells of 2 x 2 pixels differs from the mean of its cell by more than the `share` of
    it.

    The difference is the upper median over the cells, every `step`-th in both directions, that are brighter than the
    upper median of all and than `min_level`.
    """
    return bool(kernels().has_mosaic(image, step, min_level, share))


def bad_pixels(image: GreyImage, first: int, stride: int, step: float, share: float) -> tuple[int, float]:
    """Return the number of inner pixels, in every `stride`-th row from the `first`, that differ from all of their
    neighbours by more than `step` and by more than `share` of the range of brightness in these rows, and that range."""
    count, span = kernels().count_bad_pixels(image, first, stride, step, share)
    return count, float(span[0])


def alternating(image: GreyImage, groups: int, tiles: int, step: float) -> tuple[IntArray, IntArray]:
    """Return the numbers of places in each of `tiles` x `tiles` parts of the image whose differences within four lines
    alternate from line to line, and of those where they lie between the first and the last two lines.

    The larger of both is at least `step`, the sum of four grey levels. `groups` of four lines, a multiple of `tiles`,
    are looked at, each from an even line on.
    """
    more, less = kernels().count_alternating(image, groups, tiles, step)
    return more, less


def shrunk(image: GreyImage, factor: int) -> Image:
    """Return the means of `factor` x `factor` pixels."""
    if image.dtype == np.uint8 and factor <= MAX_SUMMED:
        return np.asarray(kernels().shrink_bytes(image, factor))
    return np.asarray(kernels().shrink_floats(image.astype(np.float32, copy=False), factor))


def level(image: GreyImage, rules: LevelRules, step: int) -> tuple[Image, Image, Image]:
    """Return the smoothed `image`, every second of its pixels in both directions, and the threshold on the response of
    peaks per block of STRIP pixels x STRIP_ROWS rows, from the local brightness and every `step`-th inner pixel."""
    height, width = image.shape
    half_height, half_width = (height + 1) // 2, (width + 1) // 2
    # One block of memory, which the allocator reuses for the next image.
    block = np.empty(height * width + half_height * half_width, np.float32)
    smooth, half = block[: height * width].reshape(height, width), block[height * width :].reshape(-1, half_width)
    return smooth, half, kernels().make_level(image, step, rules, smooth, half)


def peaks(smooth: Image, above: Image, limit: int, side: int, finest: int) -> tuple[NDArray[np.int32], Image]:
    """Return (u, v) and response of the peaks above their thresholds (`level`), row by row.

    If there are more than `limit`, about that number is kept: those with the largest response over the largest one in
    their block of `side` pixels, quantised to `finest` steps.
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
    """Saddles and corners at the peaks of a level, in pixels of the full image.

    Attributes
    ----------
    saddles : (N, 2)
    pixels, angles, contrast : (M, 2), (M, 2) and (M,), of the corners among these.
    smeared : (M,) whether they have motion blur.
    repeated : (M,) whether there is a known corner nearby.
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
    """Return the saddles and corners at the peaks `at` (P, 2) of a level.

    Parameters
    ----------
    tests : radius of the rings, largest step to a saddle, largest response relative to the square of the contrast.
    to_full : scale and offset of the level.
    known : (K, 2) known corners; corners within `reach` of one are marked as repeated.
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
    """Return which of `fresh` (N, 2) are within `reach` of any of `known` (M, 2)."""
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

    `lines` (N, 2, 2) are the unit vectors of A and B, `bounds` the smallest and largest contrasts (N,) of possible
    neighbours, `reach` (N,) the largest distance from the edge at which brightness is read.
    """
    min_contrast, max_contrast = bounds
    given = make_struct(
        "corners_t",
        pixels=pixels,
        lines=lines,
        contrast=contrast,
        min_contrast=min_contrast,
        max_contrast=max_contrast,
        reach=reach,
    )
    done, both = kernels().find_links(given, ImageOf.of(brightness=image), scale, offset, rules)
    if not done:
        raise MemoryError
    return np.asarray(both)
