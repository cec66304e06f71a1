"""Pixels that show nothing of the scene: hot and dead ones, salt and pepper of a bad line.

No lens makes a single pixel stand out of all of its neighbours by far, so what does is the sensor's doing. A sparse
look tells whether an image has such pixels at all; if so, all are found and replaced by what lies around them.
"""

from __future__ import annotations

import cv2
import numpy as np

from rigkit.core.arrays import IntArray
from rigkit.detection.saddles.response import GreyImage
from rigkit.kernels import front

LOOKED_AT = 6000
"""Pixels of the sparse look, in whole rows."""

MIN_EVIDENT = 3
"""So many of them stand out where an image has bad pixels: one in 2000. Fewer move few corners, and by little."""

BAD_PIXEL_SIGMAS, SPAN_SHARE = 8.0, 0.15
"""A pixel stands out if it differs from its neighbours by so many standard deviations of the noise, and by this part of
the range of brightness: sharpened corners ring by less."""

MIN_CLEAR_OF = 7
"""A bad pixel is so much brighter than so many of its eight neighbours, or so much darker: where many are bad, some lie
side by side. Of the corner of a square, five neighbours are."""

REPAIR_ROUNDS = 2
"""What three bad pixels in a row have hidden of each other shows when those beside them are gone."""

NEIGHBOUR_STEPS: IntArray = np.array([(v, u) for v in (-1, 0, 1) for u in (-1, 0, 1) if v or u])


def without_bad_pixels(grey: GreyImage) -> GreyImage:
    """Return `grey` with its bad pixels replaced by the median of the good ones around them; as it is without any."""
    step = _evident(grey)
    if step is None:
        return grey
    out = grey.copy()
    for _ in range(REPAIR_ROUNDS):
        _repair(out, step)
    return out


def _evident(grey: GreyImage) -> float | None:
    """Return by how much bad pixels stand out, None where a sparse look finds hardly any."""
    height, width = grey.shape
    apart = max(3, width * height // LOOKED_AT)
    first = 1 + (height - 3) % apart // 2
    count, span = front.bad_pixels(grey, first, apart, 0.0, SPAN_SHARE)
    if count < MIN_EVIDENT:
        return None
    above, here, below = (grey[first + k : height - 1 + k : apart].astype(np.float64) for k in (-1, 0, 1))
    rough = np.abs(here - 0.5 * above - 0.5 * below).ravel()
    # The difference of a pixel and the mean of two has a median of 0.6745 sqrt(1.5) sigma.
    sigma = float(np.partition(rough, len(rough) // 2)[len(rough) // 2]) / 0.826
    step = max(BAD_PIXEL_SIGMAS * sigma, SPAN_SHARE * span)
    return step if front.bad_pixels(grey, first, apart, step, 0.0)[0] >= MIN_EVIDENT else None


def _repair(image: GreyImage, step: float) -> None:
    """Replace the pixels that stand out by `step` by the median of those around them that do not, IN PLACE."""
    height, width = image.shape
    row, column = np.nonzero(cv2.absdiff(image, cv2.medianBlur(image, 3)) > step)
    rows, columns = row[:, None] + NEIGHBOUR_STEPS[:, 0], column[:, None] + NEIGHBOUR_STEPS[:, 1]
    inside = (rows >= 0) & (rows < height) & (columns >= 0) & (columns < width)
    rows, columns = np.where(inside, rows, row[:, None]), np.where(inside, columns, column[:, None])
    own, around = image[row, column].astype(np.float32)[:, None], image[rows, columns].astype(np.float32)
    # Where the frame ends nothing contradicts.
    brighter, darker = (((step < off) | ~inside).sum(axis=1) >= MIN_CLEAR_OF for off in (own - around, around - own))
    bad = np.zeros(image.shape, bool)
    which = np.flatnonzero(brighter | darker)
    bad[row[which], column[which]] = True
    good = np.sort(np.where(inside & ~bad[rows, columns], around, np.nan)[which], axis=1)
    count = np.isfinite(good).sum(axis=1)
    which, good, count = which[count > 0], good[count > 0], count[count > 0]
    each = np.arange(len(which))
    middle = 0.5 * (good[each, (count - 1) // 2] + good[each, count // 2])
    image[row[which], column[which]] = middle if image.dtype == np.float32 else np.rint(middle)
