"""Raw images of colour cameras: mosaics of red, green and blue pixels (Bayer or another 2 x 2 pattern).

A board is black and white, so that its pixels differ only by the sensitivity of their colour. Scaled to equal
sensitivity they are a grey image of full resolution, without demosaicing.
"""

from __future__ import annotations

import numpy as np

from rigkit.core.arrays import BoolArray, FloatArray
from rigkit.detection.saddles.response import FloatImage, GreyImage
from rigkit.kernels import front

GLANCE, LOOK = 1500, 20000
"""Number of cells of 2 x 2 pixels by which a mosaic is detected, and of those by which it is scaled."""

MOSAIC_SHARE = 0.03
"""Smallest median difference of a position in the cells from their mean, over that mean, in a mosaic. 586 images of
boards and photographs have 0.009 at most, mosaics 0.1 to 0.5 unless they are white-balanced, when nothing is to be
done.
"""

PLACES = ((0, 0), (0, 1), (1, 0), (1, 1))
"""Positions in a cell: row, column."""

MIN_LEVELS = 12.0
"""Smallest mean of a cell, grey levels, that is used: rounding affects darker ones."""


def without_mosaic(grey: GreyImage) -> GreyImage:
    """Return `grey` with the four positions of its 2 x 2 cells on one scale; unchanged if it is not a mosaic, or if a
    position has hardly any light: dots of a print, or of an image of two levels."""
    if not front.has_mosaic(grey, _step(grey, GLANCE), MIN_LEVELS, MOSAIC_SHARE):
        return grey
    values = _squares(grey, LOOK)
    mean = values.mean(axis=0)
    bright = mean > max(float(np.median(mean)), MIN_LEVELS)
    if not np.median(values[:, bright], axis=1).all():
        return grey
    out: FloatImage = grey.astype(np.float32)
    for (v, u), own in zip(PLACES, values, strict=True):
        gain, offset = _line(own, mean, bright)
        out[v::2, u::2] = gain * out[v::2, u::2] + offset
    return np.clip(out, 0.0, 255.0, out=out)


def _step(grey: GreyImage, count: int) -> int:
    """Return the step, in cells, for a sample of about `count` cells."""
    height, width = (side // 2 for side in grey.shape)
    return max(1, int(np.sqrt(height * width / count)))


def _squares(grey: GreyImage, count: int) -> FloatArray:
    """Return the brightness at the four PLACES of about `count` cells, (4, N)."""
    step = _step(grey, count)
    down, across = (side // 2 // step for side in grey.shape)
    cells = grey[: 2 * step * down, : 2 * step * across].reshape(down, 2 * step, across, 2 * step)
    return cells[:, :2, :, :2].transpose(1, 3, 0, 2).astype(np.float64).reshape(len(PLACES), -1)


def _line(own: FloatArray, mean: FloatArray, bright: BoolArray) -> tuple[np.float32, np.float32]:
    """Return gain and offset from the brightness of one position to the mean of the cell, from the dark and the bright
    half of the cells."""
    (dark_own, dark_mean), (bright_own, bright_mean) = (_middle(own[half], mean[half]) for half in (~bright, bright))
    span = bright_own - dark_own
    gain = (bright_mean - dark_mean) / span if span > 1.0 else bright_mean / bright_own
    return np.float32(gain), np.float32(bright_mean - gain * bright_own)


def _middle(own: FloatArray, mean: FloatArray) -> tuple[float, float]:
    """Return the means of both over the cells with a ratio between its quartiles, which excludes coloured objects."""
    ratio = own / np.maximum(mean, 1.0)
    low, high = np.quantile(ratio, (0.25, 0.75))
    typical = (ratio >= low) & (ratio <= high)
    return float(own[typical].mean()), float(mean[typical].mean())
