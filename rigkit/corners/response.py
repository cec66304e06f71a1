"""Where an image could have a chessboard corner: an image pyramid, its saddle response, and the peaks of the response.

A chessboard corner is a saddle of the brightness. On an image L smoothed a little, the response is minus the
determinant of the Hessian, D = Lxy^2 - Lxx Lyy: large at saddles, zero along straight edges, negative at blobs, and
indifferent to the direction of the lines. What counts as large follows from the image's own median response, that is
its noise.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from rigkit.arrays import FloatArray, IntArray
from rigkit.errors import InputError

__all__ = ["FloatImage", "Level", "grey_image", "peaks", "pyramid", "sample"]

FloatImage = NDArray[np.float32]

BASE_PIXELS = 2.6e6
"""The finest level of the search has at most this many pixels; only the sub-pixel fit looks at larger images."""

OCTAVES = 3
"""Levels of the search, each of half the size of the one before: blurred corners are saddles only at coarse levels."""

SMOOTH = np.array([1.0, 4.0, 6.0, 4.0, 1.0], np.float32) / 16.0
"""Binomial of sigma 1."""

NOISE_FACTOR = 8.0
"""A peak stands out of the noise from this multiple of the median |D| upwards."""

FLOOR, CEILING = 2.0, 16.0
"""Bounds of the threshold on D for an image that spans 200 grey levels, in (grey levels per px^2)^2; they go with the
square of the span. Below the floor is only quantisation and compression, and the median of a richly textured image must
not hide the corners of a board in it."""

LEAST_SPAN = 2.5
"""An image that spans fewer grey levels shows nothing but its quantisation."""

MAX_PEAKS = 20000
"""Keep the strongest peaks of a level: texture may have more, a board never."""


@dataclass(frozen=True, eq=False, slots=True)
class Level:
    """One level of the pyramid.

    Attributes
    ----------
    smooth : (H, W) float32, 0..255.
    response : (H, W) float32, D.
    threshold : smallest D of a peak.
    scale, offset : full-resolution pixel = scale * level pixel + offset.
    """

    smooth: FloatImage
    response: FloatImage
    threshold: float
    scale: float
    offset: float

    def to_level(self, pixels: FloatArray) -> FloatArray:
        """Return full-resolution `pixels` in pixels of this level."""
        return (pixels - self.offset) / self.scale

    def to_full(self, pixels: FloatArray) -> FloatArray:
        """Return pixels of this level in full-resolution pixels."""
        return pixels * self.scale + self.offset


def grey_image(image: NDArray[np.generic]) -> FloatImage:
    """Return an 8- or 16-bit, grey or RGB(A) image as grey float32, 0..255.

    16-bit images are scaled by their own brightest value (the 99.9 % quantile), because 10- and 12-bit sensors do not
    fill the range. Floating-point images are taken as 0..255 as they are.

    Raises
    ------
    InputError
        Not an image of 1, 3 or 4 channels, or of another type, or smaller than 16x16.
    """
    array = np.asarray(image)
    if array.ndim == 3 and array.shape[2] == 1:
        array = array[:, :, 0]
    if array.ndim not in (2, 3) or (array.ndim == 3 and array.shape[2] not in (3, 4)):
        raise InputError(f"image: expected (H, W) or (H, W, 3 or 4), got {array.shape}; pass one image at a time")
    if min(array.shape[:2]) < 16:
        raise InputError(f"image: {array.shape[1]}x{array.shape[0]} pixels are too few to hold a chessboard")
    if array.dtype not in (np.uint8, np.uint16, np.float32, np.float64):
        raise InputError(f"image: type {array.dtype} is not supported; convert it to uint8 or uint16")
    if array.dtype == np.float64:
        array = array.astype(np.float32)
    if array.ndim == 3:
        array = cv2.cvtColor(array, cv2.COLOR_RGB2GRAY if array.shape[2] == 3 else cv2.COLOR_RGBA2GRAY)
    grey = np.ascontiguousarray(array, dtype=np.float32)
    if array.dtype == np.uint16:
        step = max(1, int(np.sqrt(grey.size / 1e5)))
        brightest = float(np.quantile(grey[::step, ::step], 0.999))
        grey = np.minimum(grey * np.float32(255.0 / max(brightest, 1.0)), np.float32(255.0))
    return grey


def pyramid(grey: FloatImage) -> list[Level]:
    """Return the levels of the search, the finest first."""
    base, scale = grey, 1.0
    while base.size > BASE_PIXELS:
        half = (base.shape[1] // 2, base.shape[0] // 2)
        smaller = cv2.resize(base[: 2 * half[1], : 2 * half[0]], half, interpolation=cv2.INTER_AREA)
        base = np.asarray(smaller, np.float32)
        scale *= 2.0
    offset = 0.5 * (scale - 1.0)
    levels: list[Level] = []
    while len(levels) < OCTAVES and min(base.shape) >= 16:
        level = _level(base, scale, offset)
        levels.append(level)
        base = np.ascontiguousarray(level.smooth[::2, ::2])
        scale *= 2.0
    return levels


def _level(image: FloatImage, scale: float, offset: float) -> Level:
    smooth = cv2.sepFilter2D(image, cv2.CV_32F, SMOOTH, SMOOTH, borderType=cv2.BORDER_REPLICATE)
    second = np.array([1.0, -2.0, 1.0], np.float32)
    first = np.array([-0.5, 0.0, 0.5], np.float32)
    lxx = cv2.filter2D(smooth, cv2.CV_32F, second[None])
    lyy = cv2.filter2D(smooth, cv2.CV_32F, second[:, None])
    lxy = cv2.sepFilter2D(smooth, cv2.CV_32F, first, first)
    # In place: fresh pages of memory cost as much as the arithmetic.
    cv2.multiply(lxx, lyy, dst=lxx)
    cv2.multiply(lxy, lxy, dst=lxy)
    response = cv2.subtract(lxy, lxx, dst=lxy)
    step = max(1, int(np.sqrt(response.size / 3e4)))
    typical = float(np.median(np.abs(response[::step, ::step])))
    low, high = np.quantile(smooth[::step, ::step], (0.002, 0.998))
    contrast = (max(float(high - low), LEAST_SPAN) / 200.0) ** 2
    threshold = float(np.clip(NOISE_FACTOR * typical, FLOOR * contrast, CEILING * contrast))
    return Level(np.asarray(smooth, np.float32), np.asarray(response, np.float32), threshold, scale, offset)


def peaks(level: Level) -> IntArray:
    """Return the local maxima of the response above the threshold, (N, 2) as (u, v) of the level, strongest first."""
    response = level.response
    highest = cv2.dilate(response, np.ones((5, 5), np.uint8))
    mask = (response >= highest) & (response > level.threshold)
    mask[:3] = mask[-3:] = False
    mask[:, :3] = mask[:, -3:] = False
    flat = np.flatnonzero(mask)
    flat = flat[~_repeated(response.ravel(), flat, response.shape[1])]
    flat = flat[np.argsort(-response.ravel()[flat], kind="stable")][:MAX_PEAKS]
    v, u = np.divmod(flat, response.shape[1])
    return np.stack([u, v], axis=-1)


def _repeated(response: FloatImage, flat: IntArray, width: int) -> NDArray[np.bool_]:
    """Return which peaks have an equal one before them in their neighbourhood: a corner between pixels makes two."""
    value = response[flat]
    repeated = np.zeros(len(flat), bool)
    for dv, du in ((0, -1), (0, -2), *((dv, du) for dv in (-1, -2) for du in (-2, -1, 0, 1, 2))):
        repeated |= response[flat + dv * width + du] == value
    return repeated


def sample(image: FloatImage, pixels: NDArray[np.floating]) -> FloatImage:
    """Return `image` at `pixels` (..., 2), bilinear, the border repeated; (...) float32."""
    flat = np.asarray(pixels, np.float32).reshape(-1, 2)
    width = 1024
    padded = np.zeros((-(-max(len(flat), 1) // width) * width, 2), np.float32)
    padded[: len(flat)] = flat
    grid = padded.reshape(-1, width, 2)
    values = cv2.remap(image, grid[..., 0], grid[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(values, np.float32).reshape(-1)[: len(flat)].reshape(pixels.shape[:-1])
