"""Calls of the kernels in looks.c, smoothing.c, peaks.c, corners.c and links.c: plain arrays; tolerances are the
callers'."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from rigkit.core.arrays import BoolArray, FloatArray, GreyImage, IntArray
from rigkit.kernels import kernels
from rigkit.kernels.calls import Struct, image_arguments, structure
from rigkit.kernels.declarations import header

_CONSTANTS = header().constants
STRIP, STRIP_ROWS, STRIPS_FROM, HALF = (_CONSTANTS[name] for name in ("STRIP", "STRIP_ROWS", "STRIPS_FROM", "HALF"))

WHOLE = 16.0
"""A kernel of multiples of 1/16 smooths bytes exactly in integers of 16 bits."""

MAX_SUMMED = 256
"""Bytes whose sum fits 16 bits."""

Image = NDArray[np.float32]


@structure("ring_rules_t")
class RingRules(Struct):
    """How rings are read."""

    @classmethod
    def make(cls, circle: Image, gains: FloatArray, **numbers: float) -> RingRules:
        """Return the rules; `circle` (2 * HALF, 2) are the samples of a ring of radius 1."""
        samples = np.ascontiguousarray(circle, np.float32)
        return cls.of(circle=samples, gains=gains, gain_count=len(gains), **numbers)


@structure("link_rules_t")
class LinkRules(Struct):
    """How links are found."""

    @classmethod
    def make(cls, neighbours: int, along: FloatArray, most: int, **numbers: float) -> LinkRules:
        """Return the rules; `along` are the places of an edge that are looked at."""
        places = np.ascontiguousarray(along, np.float64)
        return cls.of(neighbours=neighbours, along=places, places=len(places), most=most, **numbers)


@structure("image_t")
class ImageOf(Struct):
    """An image of brightness, float32."""

    @classmethod
    def make(cls, image: Image) -> ImageOf:
        height, width = image.shape
        return cls.of(brightness=image, height=height, width=width)


@structure("corners_t")
class _CornerArrays(Struct):
    """The corners that links are sought for."""


def square_ratios(image: GreyImage, step: int, least: float) -> tuple[FloatArray, int]:
    """Return the upper medians (4,) of how bright the pixels of squares of 2 x 2 are (row by row), beside the mean of
    their square, and of how many squares: of every `step`-th both ways those brighter than the upper median of all, and
    than `least`."""
    grey, bytewise, width, height = image_arguments(image)
    scratch, out = np.empty(3 * (height // 2 // step) * (width // 2 // step) + 1), np.empty(4)
    return out, kernels().square_ratios(grey, bytewise, width, height, step, least, scratch, out)


def bad_pixels(image: GreyImage, first: int, apart: int, step: float, share: float) -> tuple[int, float]:
    """Return how many inner pixels of every `apart`-th row from the `first` on stand out of all of their neighbours by
    more than `step` and by more than `share` of the range of brightness in these rows; and that range."""
    span = np.empty(1)
    grey, bytewise, width, height = image_arguments(image)
    count = kernels().count_bad_pixels(grey, bytewise, width, height, first, apart, step, share, span)
    return count, float(span[0])


def shrunk(image: GreyImage, factor: int) -> Image:
    """Return the means of `factor` x `factor` pixels."""
    height, width = image.shape
    bytewise = image.dtype == np.uint8 and factor <= MAX_SUMMED
    image = image if bytewise else image.astype(np.float32, copy=False)
    sums = np.empty(2 * width, np.uint16) if bytewise else np.empty(width, np.float32)
    out = np.empty((height // factor, width // factor), np.float32)
    shrink = kernels().shrink_bytes if bytewise else kernels().shrink_floats
    shrink(np.ascontiguousarray(image), height, width, factor, sums, out)
    return out


def smoothed(image: GreyImage, kernel: Image) -> tuple[Image, Image]:
    """Return `image` smoothed with the symmetric `kernel` (5,), of multiples of 1/WHOLE, both ways, and every second of
    its pixels both ways."""
    height, width = image.shape
    half_height, half_width = (height + 1) // 2, (width + 1) // 2
    # One block of memory: the allocator keeps it for the next image, as it would not two.
    block = np.empty(height * width + half_height * half_width, np.float32)
    smooth, half = block[: height * width].reshape(height, width), block[height * width :].reshape(-1, half_width)
    if image.dtype == np.uint8:
        column = np.empty(width + 4, np.uint16)
        kernels().smooth_bytes(np.ascontiguousarray(image), height, width, kernel, WHOLE, column, smooth, half)
    else:
        sums = np.empty(width + 4, np.float32)
        kernels().smooth_floats(np.ascontiguousarray(image), height, width, kernel, sums, smooth, half)
    return smooth, half


def typical(smooth: Image, step: int, extreme: float) -> tuple[float, float, float]:
    """Return the upper median of |response|, and how bright all but the part `extreme` at either end are, at least and
    at most: at every `step`-th inner pixel of every `step`-th inner row."""
    height, width = smooth.shape
    seen = np.empty((3, -(-(height - 2) // step) * -(-(width - 2) // step)), np.float32)
    out, few = np.empty(3, np.float32), int(extreme * seen.shape[1])
    kernels().typical_values(smooth, height, width, step, few, *seen, out)
    response, darkest, brightest = out.tolist()
    return response, darkest, brightest


def thresholds(smooth: Image, floor: float, least: float, darkest: float, brightest: float) -> Image:
    """Return for each STRIP pixels of STRIP_ROWS rows `floor` times the square of how bright they get, `darkest` being
    0 and `brightest` 1, but `least` at least."""
    height, width = smooth.shape
    out = np.empty((height // STRIP_ROWS + 1, width // STRIP + 1), np.float32)
    kernels().fill_thresholds(smooth, height, width, floor, least, darkest, brightest, out)
    return out


def peaks(smooth: Image, above: Image, limit: int, side: int, finest: int) -> tuple[NDArray[np.int32], Image]:
    """Return (u, v) and response of the peaks above their `thresholds`, row by row.

    Of more than `limit` peaks, about so many are kept: those strongest beside the strongest in their square of `side`
    pixels, to one part in `finest`.
    """
    height, width = smooth.shape
    most = (height // 3 + 1) * (width // 3 + 1)
    at, response = np.empty((most, 2), np.int32), np.empty(most, np.float32)
    scratch, high = np.empty(5 * (width + STRIP + 4), np.float32), np.empty(5 * (width // STRIP + 1), np.uint8)
    found = kernels().find_peaks(smooth, height, width, above, scratch, high, at, response)
    at, response = at[:found], response[:found]
    if found > limit:
        squares = np.zeros((height // side + 1) * (width // side + 1), np.float32)
        bins, share = np.zeros(finest + 1, np.int32), np.empty(found, np.int32)
        found = kernels().keep_strongest(at, response, found, height, width, side, limit, finest, squares, bins, share)
    return at[:found], response[:found]


def corners(
    smooth: Image,
    at: NDArray[np.signedinteger],
    response: Image,
    radius: float,
    most_step: float,
    most_sharp: float,
    rules: RingRules,
) -> tuple[FloatArray, IntArray, FloatArray, FloatArray, BoolArray]:
    """Return the saddles next to the peaks `at` (N, 2); of the corners among them: which, angles (M, 2), contrast, and
    whether only motion explains their middle."""
    at, response = np.ascontiguousarray(at, np.int32), np.ascontiguousarray(response, np.float32)
    count, found = len(at), np.zeros(1, np.int64)
    pixels, which = np.empty((count, 2)), np.empty(count, np.int64)
    # A ring is read before it is known whether it is kept.
    angles, contrast, smeared = np.empty((count + 1, 2)), np.empty(count + 1), np.empty(count + 1, np.uint8)
    near = kernels().find_corners(
        *(ImageOf.make(smooth), rules, radius, most_step, most_sharp),
        *(at, response, count, pixels, which, angles, contrast, smeared, found),
    )
    size = int(found[0])
    return pixels[:near], which[:size], angles[:size], contrast[:size], smeared[:size] > 0


def near_any(fresh: FloatArray, known: FloatArray, reach: float) -> BoolArray:
    """Return which of `fresh` (N, 2) lie within `reach` of any of `known` (M, 2)."""
    if not len(fresh) or not len(known):
        return np.zeros(len(fresh), np.bool_)
    mark = np.empty(len(fresh), np.bool_)
    if not kernels().mark_known(fresh, len(fresh), known, len(known), reach, mark):
        raise MemoryError
    return mark


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
    least, most = bounds
    given = _CornerArrays.of(
        pixels=pixels, lines=lines, contrast=contrast, least=least, most=most, reach=reach, count=len(pixels)
    )
    nearest, both = np.empty((2, len(pixels), 4), np.int64)
    if not kernels().find_links(given, ImageOf.make(image), scale, offset, rules, nearest, both):
        raise MemoryError
    return np.asarray(both)
