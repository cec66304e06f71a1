"""Raw images of colour cameras: a mosaic of pixels that see red, green or blue (Bayer's or another pattern of 2 x 2).

A board is black and white, so its pixels differ by the sensitivity of their colour alone. Brought to one scale they are
a grey image of full resolution, without the interpolation that makes an image of colours out of them.
"""

from __future__ import annotations

import numpy as np

from rigkit.core.arrays import BoolArray, FloatArray
from rigkit.detection.saddles.response import FloatImage, GreyImage
from rigkit.kernels import front

GLANCE, LOOK = 1500, 20000
"""Squares of 2 x 2 pixels that tell whether there is a mosaic, and those that tell its scales."""

MOSAIC_SHARE = 0.03
"""A place in the squares that is, in the median, brighter or darker than its square by this part of it is of another
colour. 586 pictures of boards and photographs have 0.009 at most, mosaics 0.1 to 0.5 unless they are white-balanced,
when there is nothing to do."""

PLACES = ((0, 0), (0, 1), (1, 0), (1, 1))
"""In a square: row, column."""

MIN_LEVELS = 12.0
"""Darker squares, grey levels, say nothing: rounding is a part of them."""


def without_mosaic(grey: GreyImage) -> GreyImage:
    """Return `grey` with the four places of its squares of 2 x 2 pixels on one scale; as it is where they are so."""
    if not front.has_mosaic(grey, _step(grey, GLANCE), MIN_LEVELS, MOSAIC_SHARE):
        return grey
    values = _squares(grey, LOOK)
    mean = values.mean(axis=0)
    bright = mean > max(float(np.median(mean)), MIN_LEVELS)
    out: FloatImage = grey.astype(np.float32)
    for (v, u), own in zip(PLACES, values, strict=True):
        gain, offset = _line(own, mean, bright)
        out[v::2, u::2] = gain * out[v::2, u::2] + offset
    return np.clip(out, 0.0, 255.0, out=out)


def _step(grey: GreyImage, count: int) -> int:
    """Return how many squares lie from one to the next where about `count` are looked at."""
    height, width = (side // 2 for side in grey.shape)
    return max(1, int(np.sqrt(height * width / count)))


def _squares(grey: GreyImage, count: int) -> FloatArray:
    """Return the brightness at the four PLACES of about `count` squares, (4, N)."""
    step = _step(grey, count)
    down, across = (side // 2 // step for side in grey.shape)
    cells = grey[: 2 * step * down, : 2 * step * across].reshape(down, 2 * step, across, 2 * step)
    return cells[:, :2, :, :2].transpose(1, 3, 0, 2).astype(np.float64).reshape(len(PLACES), -1)


def _line(own: FloatArray, mean: FloatArray, bright: BoolArray) -> tuple[np.float32, np.float32]:
    """Return gain and offset that take the brightness of one place to the mean of the square, by the dark and by the
    bright half of the squares: the middle halves of either, where fewer are of other colours."""
    (dark_own, dark_mean), (bright_own, bright_mean) = (_middle(own[half], mean[half]) for half in (~bright, bright))
    span = bright_own - dark_own
    gain = (bright_mean - dark_mean) / span if span > 1.0 else bright_mean / bright_own
    return np.float32(gain), np.float32(bright_mean - gain * bright_own)


def _middle(own: FloatArray, mean: FloatArray) -> tuple[float, float]:
    """Return the means of both over the squares whose ratio of them is usual."""
    ratio = own / np.maximum(mean, 1.0)
    low, high = np.quantile(ratio, (0.25, 0.75))
    typical = (ratio >= low) & (ratio <= high)
    return float(own[typical].mean()), float(mean[typical].mean())
