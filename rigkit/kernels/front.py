"""Calls of the kernels in front.c: plain arrays in, plain arrays out; all tolerances come from the callers."""

from __future__ import annotations

import ctypes
import functools
from ctypes import POINTER, Structure, byref, c_double, c_float, c_int64, c_void_p
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from rigkit.core.arrays import BoolArray, FloatArray, IntArray
from rigkit.kernels import address, kernels

__all__ = ["LinkRules", "RingRules", "corners", "links", "loaded", "near_any", "peaks", "shrunk", "smoothed", "typical"]

STRIP = 64
"""As in front.c: rows of scratch memory are longer than the image by this and a peak's neighbourhood."""

HALF = 16
"""Samples of a ring in half a turn, as in kernels.h."""

WHOLE = 16.0
"""A kernel of multiples of 1/16 smooths bytes exactly in integers of 16 bits."""

MOST_SUMMED = 256
"""Bytes whose sum fits 16 bits."""

Image = NDArray[np.float32]
Picture = NDArray[np.uint8] | NDArray[np.float32]


class RingRules(Structure):
    """ring_rules_t; `make` also keeps the arrays that it points to."""

    _fields_: ClassVar = [
        *((name, c_void_p) for name in ("circle", "gains")),
        ("gain_count", c_int64),
        *(
            (name, c_double)
            for name in ("most_odd", "most_centre", "most_cosine", "quick_odd", "quick_centre", "quick_sharp")
        ),
    ]

    @classmethod
    def make(cls, circle: Image, gains: FloatArray, **numbers: float) -> RingRules:
        """Return the rules; `circle` (2 * HALF, 2) are the samples of a ring of radius 1."""
        if circle.shape != (2 * HALF, 2):
            raise ValueError(f"ring of {len(circle)} samples: the kernels read {2 * HALF}, HALF in kernels.h")
        kept = np.ascontiguousarray(circle, np.float32), np.ascontiguousarray(gains, np.float64)
        rules = cls(address(kept[0]), address(kept[1]), len(kept[1]), **numbers)
        rules.kept = kept
        return rules


class LinkRules(Structure):
    """link_rules_t; `make` also keeps the array that it points to."""

    _fields_: ClassVar = [
        *((name, c_int64) for name in ("neighbours", "places", "most")),
        ("along", c_void_p),
        *((name, c_double) for name in ("arm_cosine", "contrast_ratio", "length_ratio", "aside", "least_aside")),
    ]

    @classmethod
    def make(cls, neighbours: int, along: FloatArray, most: int, **numbers: float) -> LinkRules:
        """Return the rules; `along` are the places of an edge that are looked at."""
        kept = np.ascontiguousarray(along, np.float64)
        rules = cls(neighbours, len(kept), most, address(kept), **numbers)
        rules.kept = kept
        return rules


class _Image(Structure):
    _fields_: ClassVar = [("brightness", c_void_p), ("width", c_int64), ("height", c_int64)]

    @classmethod
    def of(cls, image: Image) -> _Image:
        return cls(address(image), image.shape[1], image.shape[0])


class _Corners(Structure):
    _fields_: ClassVar = [
        *((name, c_void_p) for name in ("pixels", "lines", "contrast", "least", "most", "reach")),
        ("count", c_int64),
    ]


@functools.cache
def loaded() -> ctypes.CDLL | None:
    """Return the library, None where the kernels are not to be had."""
    library = kernels("front")
    if library is None:
        return None
    array, size = c_void_p, c_int64
    library.shrink_floats.argtypes = [array, size, size, size, array, array]
    library.shrink_bytes.argtypes = library.shrink_floats.argtypes
    library.smooth_floats.argtypes = [array, size, size, *[array] * 4]
    library.smooth_bytes.argtypes = [array, size, size, array, c_float, *[array] * 3]
    library.typical_values.argtypes = [array, size, size, size, array, array]
    for name in ("shrink_floats", "shrink_bytes", "smooth_floats", "smooth_bytes", "typical_values"):
        getattr(library, name).restype = None
    library.find_peaks.argtypes = [array, size, size, c_float, *[array] * 4]
    library.keep_strongest.argtypes = [array, array, *[size] * 5, *[array] * 3]
    rings = (_Image, POINTER(RingRules), c_double, c_double, c_double)
    library.find_corners.argtypes = [*rings, array, array, size, *[array] * 5]
    library.mark_known.argtypes = [array, size, array, size, c_double, array]
    library.find_links.argtypes = [
        *(POINTER(_Corners), _Image, c_double, c_double, POINTER(LinkRules)),
        *(array, array),
    ]
    for name in ("find_peaks", "keep_strongest", "find_corners", "mark_known", "find_links"):
        getattr(library, name).restype = size
    return library


def shrunk(library: ctypes.CDLL, image: Picture, factor: int) -> Image:
    """Return the means of `factor` x `factor` pixels."""
    height, width = image.shape
    bytewise = image.dtype == np.uint8 and factor <= MOST_SUMMED
    image = image if bytewise else image.astype(np.float32, copy=False)
    sums = np.empty(width, np.uint16 if bytewise else np.float32)
    out = np.empty((height // factor, width // factor), np.float32)
    shrink = library.shrink_bytes if bytewise else library.shrink_floats
    shrink(address(image), height, width, factor, address(sums), address(out))
    return out


def smoothed(library: ctypes.CDLL, image: Picture, kernel: Image) -> tuple[Image, Image]:
    """Return `image` smoothed with the symmetric `kernel` (5,), of multiples of 1/WHOLE, both ways, and every second of
    its pixels both ways."""
    height, width = image.shape
    half_height, half_width = (height + 1) // 2, (width + 1) // 2
    # One block of memory: the allocator keeps it for the next image, as it would not two.
    block = np.empty(height * width + half_height * half_width, np.float32)
    smooth, half = block[: height * width].reshape(height, width), block[height * width :].reshape(-1, half_width)
    if image.dtype == np.uint8:
        column = np.empty(width + 4, np.uint16)
        arrays = (address(column), address(smooth), address(half))
        library.smooth_bytes(address(image), height, width, address(kernel), WHOLE, *arrays)
    else:
        column = np.empty(width + 4, np.float32)
        arrays = (address(column), address(smooth), address(half))
        library.smooth_floats(address(image), height, width, address(kernel), *arrays)
    return smooth, half


def typical(library: ctypes.CDLL, smooth: Image, step: int) -> tuple[Image, Image]:
    """Return |response| and brightness at every `step`-th inner pixel of every `step`-th inner row."""
    height, width = smooth.shape
    out = np.empty((2, -(-(height - 2) // step) * -(-(width - 2) // step)), np.float32)
    library.typical_values(address(smooth), height, width, step, address(out[0]), address(out[1]))
    return out[0], out[1]


def peaks(
    library: ctypes.CDLL, smooth: Image, threshold: float, limit: int, side: int, finest: int
) -> tuple[NDArray[np.int32], Image]:
    """Return (u, v) and response of the peaks above `threshold`, row by row.

    Of more than `limit` peaks, about so many are kept: those strongest beside the strongest in their square of `side`
    pixels, to one part in `finest`.
    """
    height, width = smooth.shape
    most = (height // 3 + 1) * (width // 3 + 1)
    at, response = np.empty((most, 2), np.int32), np.empty(most, np.float32)
    scratch, high = np.empty(5 * (width + STRIP + 4), np.float32), np.empty(5 * (width // STRIP + 1), np.uint8)
    arrays = (scratch, high, at, response)
    found = library.find_peaks(address(smooth), height, width, threshold, *(address(array) for array in arrays))
    if found > limit:
        squares = np.zeros((height // side + 1) * (width // side + 1), np.float32)
        bins, share = np.zeros(finest + 1, np.int32), np.empty(found, np.int32)
        scratch_of_it = (address(squares), address(bins), address(share))
        found = library.keep_strongest(
            address(at), address(response), found, width, side, limit, finest, *scratch_of_it
        )
    return at[:found], response[:found]


def corners(
    library: ctypes.CDLL,
    smooth: Image,
    at: NDArray[np.signedinteger],
    response: Image,
    radius: float,
    most_step: float,
    most_sharp: float,
    rules: RingRules,
) -> tuple[FloatArray, IntArray, FloatArray, FloatArray]:
    """Return the saddles next to the peaks `at` (N, 2); of the corners among them: which, angles (M, 2), contrast."""
    at, response = np.ascontiguousarray(at, np.int32), np.ascontiguousarray(response, np.float32)
    count, found = len(at), c_int64()
    pixels, which = np.empty((count, 2)), np.empty(count, np.int64)
    # A ring is read before it is known whether it is kept.
    angles, contrast = np.empty((count + 1, 2)), np.empty(count + 1)
    near = library.find_corners(
        *(_Image.of(smooth), byref(rules), radius, most_step, most_sharp),
        *(address(at), address(response), count),
        *(address(array) for array in (pixels, which, angles, contrast)),
        byref(found),
    )
    size = found.value
    return pixels[:near], which[:size], angles[:size], contrast[:size]


def near_any(library: ctypes.CDLL, fresh: FloatArray, known: FloatArray, reach: float) -> BoolArray:
    """Return which of `fresh` (N, 2) lie within `reach` of any of `known` (M, 2), M > 0."""
    fresh, known = np.ascontiguousarray(fresh, np.float64), np.ascontiguousarray(known, np.float64)
    mark = np.empty(len(fresh), np.bool_)
    if not library.mark_known(address(fresh), len(fresh), address(known), len(known), reach, address(mark)):
        raise MemoryError
    return mark


def links(
    library: ctypes.CDLL,
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
    arrays = [np.ascontiguousarray(a, np.float64) for a in (pixels, lines, contrast, *bounds, reach)]
    given = _Corners(*(address(array) for array in arrays), len(pixels))
    out = np.empty((2, len(pixels), 4), np.int64)
    place = (address(out[0]), address(out[1]))
    if not library.find_links(byref(given), _Image.of(image), scale, offset, byref(rules), *place):
        raise MemoryError
    return np.asarray(out[1])
