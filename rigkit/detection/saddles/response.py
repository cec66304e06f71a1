"""Candidate chessboard corners: an image pyramid, its saddle response, and the peaks of the response.

A chessboard corner is a saddle of the brightness. On a slightly smoothed image L the response is minus the determinant
of the Hessian, D = Lxy^2 - Lxx Lyy: large at saddles, zero along straight edges, negative at blobs, and independent of
the direction of the lines. The threshold follows from the median response of the image, that is from its noise.
"""

from __future__ import annotations

import functools
from collections.abc import Iterator
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from rigkit.core.arrays import GreyImage as GreyImage
from rigkit.core.errors import InputError
from rigkit.kernels import front

FloatImage = NDArray[np.float32]

BASE_PIXELS = 2.6e6
"""Largest number of pixels of the finest level of the search; only the sub-pixel fit uses the full resolution."""

OCTAVES = 4
"""Levels of the search, each of half the size of the previous one. Blurred corners, and corners whose squares merge or
are round, are saddles on coarse levels only. The fourth level takes 1.5 % more time."""

SMOOTH = np.array([1.0, 4.0, 6.0, 4.0, 1.0], np.float32) / 16.0
"""Binomial filter with a standard deviation of 1."""

NOISE_FACTOR = 8.0
"""Threshold on peaks over the median of |D|."""

THRESHOLD_FLOOR, THRESHOLD_CEILING = 2.0, 16.0
"""Bounds of the threshold on D for an image with a span of 200 grey levels, in (grey levels per px^2)^2. They scale
with the square of the span, the floor also with that of the local brightness. D below the floor is due to quantisation
and compression; the ceiling limits the threshold in images with much texture."""

MIN_SPAN = 2.5
"""Smallest span of grey levels: a smaller one is quantisation."""

TYPICAL = 4e3
"""Number of pixels of the sample for median response and span of brightness; it gives the median to 3 %."""

EXTREME = 0.005
"""Share of pixels at either end that the span of brightness excludes: glints, dead pixels."""

PIXELS_A_PEAK, MAX_PEAKS = 240, 6400
"""The number of peaks kept on a level is one per PIXELS_A_PEAK pixels, at least MAX_PEAKS: texture and noise may have
more, a board never."""

PEAK_SQUARE_PX, SHARES = 32, 1024
"""Peaks are ranked by their response over the largest in their block of so many pixels, quantised to so many steps: a
board in the shade has weaker corners than a page of text in the sun."""


@dataclass(frozen=True, eq=False, slots=True)
class Level:
    """One level of the pyramid.

    Attributes
    ----------
    smooth : (H, W) float32, 0..255.
    thresholds : (bands, strips) float32, smallest D of a peak in each part of the level (`front.level`).
    scale, offset : full-resolution pixel = scale * level pixel + offset.
    """

    smooth: FloatImage
    thresholds: FloatImage
    scale: float
    offset: float


def grey_image(image: NDArray[np.generic]) -> GreyImage:
    """Return an 8- or 16-bit, grey or RGB(A) image in grey levels 0..255: uint8 as such, all others as float32.

    16-bit images are scaled by their 99.9 % quantile, because 10- and 12-bit sensors do not use the full range.
    Floating-point images are assumed to be in 0..255, NaN as dark.

    Raises InputError: not an image of 1, 3 or 4 channels, or of another type, or smaller than 16x16.
    """
    array = np.asarray(image)
    if array.ndim == 3 and array.shape[2] == 1:
        array = array[:, :, 0]
    if array.ndim not in (2, 3) or (array.ndim == 3 and array.shape[2] not in (3, 4)):
        raise InputError(
            f"image: expected (H, W) or (H, W, 3 or 4), got {array.shape}; pass one image, as read_image returns it"
        )
    if min(array.shape[:2]) < 16:
        raise InputError(
            f"image: {array.shape[1]}x{array.shape[0]} pixels are too few to hold a chessboard; give a whole picture"
        )
    # Arrays from files may have another byte order.
    array = array.astype(array.dtype.newbyteorder("="), copy=False)
    if array.dtype not in (np.uint8, np.uint16, np.float32, np.float64):
        raise InputError(f"image: type {array.dtype} is not supported; convert it to uint8 or uint16")
    if array.dtype.kind == "f":
        array = _finite(array)
    if array.ndim == 3:
        array = cv2.cvtColor(array, cv2.COLOR_RGB2GRAY if array.shape[2] == 3 else cv2.COLOR_RGBA2GRAY)
    if array.dtype == np.uint8:
        return np.ascontiguousarray(array, np.uint8)
    grey = np.ascontiguousarray(array, np.float32)
    if array.dtype == np.uint16:
        step = max(1, int(np.sqrt(grey.size / 1e5)))
        brightest = float(np.quantile(grey[::step, ::step], 0.999))
        grey = np.minimum(grey * np.float32(255.0 / max(brightest, 1.0)), np.float32(255.0))
    return grey


def as_bytes(grey: GreyImage) -> NDArray[np.uint8]:
    """Return grey levels rounded to 8 bits, those that are as they are."""
    return np.asarray(grey if grey.dtype == np.uint8 else np.clip(np.rint(grey), 0, 255), np.uint8)


def _finite(image: NDArray[np.generic]) -> FloatImage:
    """Return a floating-point image as float32, with NaN and infinities replaced by the extreme finite values."""
    with np.errstate(over="ignore"):
        values: FloatImage = image.astype(np.float32, copy=False)
        if np.isfinite(values.sum(dtype=np.float64)):
            return values
    seen = values[np.isfinite(values)]
    low, high = (float(seen.min()), float(seen.max())) if len(seen) else (0.0, 0.0)
    return np.nan_to_num(values, nan=low, posinf=high, neginf=low)


def pyramid(grey: GreyImage) -> list[Level]:
    """Return the levels of the search, the finest first."""
    return list(each_level(grey))


def each_level(grey: GreyImage) -> Iterator[Level]:
    """Yield the levels of the search, the finest first."""
    scale = _finest_scale(grey)
    base, offset = _shrunk(grey, scale), 0.5 * (scale - 1.0)
    for _ in range(OCTAVES):
        if min(base.shape) < 16:
            return
        smooth, base, thresholds = front.level(base, _level_rules(), max(1, int(np.sqrt(base.size / TYPICAL))))
        yield Level(smooth, thresholds, float(scale), offset)
        scale *= 2


def enlarged_level(grey: GreyImage) -> Level:
    """Return a level of twice the resolution of the finest one of the search: of large images in their own pixels."""
    scale = _finest_scale(grey) / 2.0
    if scale < 1.0:
        twice: GreyImage = np.zeros((2 * grey.shape[0], 2 * grey.shape[1]), grey.dtype)
        cv2.resize(grey, twice.shape[::-1], dst=twice, interpolation=cv2.INTER_CUBIC)
    else:
        twice = _shrunk(grey, int(scale))
    smooth, _, thresholds = front.level(twice, _level_rules(), max(1, int(np.sqrt(twice.size / TYPICAL))))
    return Level(smooth, thresholds, scale, 0.5 * (scale - 1.0))


def _finest_scale(grey: GreyImage) -> int:
    """Return the side, px, of the pixels of the finest level of the search."""
    scale = 1
    while grey.size > scale**2 * BASE_PIXELS:
        scale *= 2
    return scale


def _shrunk(grey: GreyImage, factor: int) -> GreyImage:
    """Return the means of `factor` x `factor` pixels."""
    return grey if factor == 1 else front.shrunk(grey, factor)


@functools.cache
def _level_rules() -> front.LevelRules:
    """Return the constants of this module for the kernels."""
    return front.LevelRules.make(
        SMOOTH,
        extreme=EXTREME,
        min_span=MIN_SPAN,
        noise_factor=NOISE_FACTOR,
        floor=THRESHOLD_FLOOR,
        ceiling=THRESHOLD_CEILING,
    )


def peaks(level: Level) -> tuple[NDArray[np.signedinteger], FloatImage]:
    """Return the local maxima of the response above the threshold, (N, 2) as (u, v) of the level, row by row, and D."""
    most = max(MAX_PEAKS, level.smooth.size // PIXELS_A_PEAK)
    return front.peaks(level.smooth, level.thresholds, most, PEAK_SQUARE_PX, SHARES)


def sample(image: GreyImage, pixels: NDArray[np.floating]) -> FloatImage:
    """Return `image` at `pixels` (..., 2), bilinear, the border repeated; (...) float32."""
    flat = np.asarray(pixels, np.float32).reshape(-1, 2)
    if image.dtype == np.uint8:
        # OpenCV rounds 8-bit results: convert the sampled part to float32.
        seen = flat[np.isfinite(flat).all(axis=1)]
        if len(seen):
            last = np.array(image.shape[::-1]) - 1
            low, high = (f(seen, axis=0).clip(0, last).astype(int) for f in (np.min, np.max))
            image = image[low[1] : high[1] + 2, low[0] : high[0] + 2]
            flat = flat - low.astype(np.float32)
        image = image.astype(np.float32)
    width = 1024
    padded = np.zeros((-(-max(len(flat), 1) // width) * width, 2), np.float32)
    padded[: len(flat)] = flat
    grid = padded.reshape(-1, width, 2)
    values = cv2.remap(image, grid[..., 0], grid[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(values, np.float32).reshape(-1)[: len(flat)].reshape(pixels.shape[:-1])
