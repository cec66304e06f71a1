"""Hot and dead pixels, columns and rows, and salt-and-pepper noise.

Since a lens blurs over more than a pixel, a pixel that differs strongly from all of its neighbours is a defect, and
so is a column (or row) that is brighter, or darker, than both neighbours nearly everywhere. A sparse sample determines
whether an image has such pixels or lines; if so, all are replaced by the median of their neighbours, and lines by the
mean of theirs.
"""

from __future__ import annotations

import cv2
import numpy as np

from rigkit.core.arrays import BoolArray, IntArray
from rigkit.detection.saddles.response import GreyImage
from rigkit.kernels import front

LOOKED_AT = 6000
"""Number of pixels in the sparse sample, in whole rows."""

MIN_EVIDENT = 3
"""Smallest number of bad pixels in the sample, one in 2000: fewer affect few corners, and little."""

BAD_PIXEL_SIGMAS, SPAN_SHARE = 8.0, 0.15
"""Smallest difference of a bad pixel from its neighbours, in standard deviations of the noise and as a part of the
range of brightness: ringing at sharpened corners is smaller."""

MIN_CLEAR_OF = 7
"""A bad pixel is brighter, or darker, than this number of its eight neighbours by that difference: some bad pixels are
adjacent. The pixel at the corner of a square differs from five."""

REPAIR_ROUNDS = 2
"""Rounds of repair: of three adjacent bad pixels the middle one is found after the others are replaced."""

SAMPLED_ACROSS = (4, 128)
EXTREME_SHARE, EVIDENT_SHARE, MAX_BAD_LINES = 0.9, 0.2, 0.05
"""Number of places along a line at which it is compared with its neighbours, at first and where that finds any; shares
of the places at which a bad line is at least as bright as both (or as dark), and brighter by SPAN_SHARE: beside
saturated or black parts a hot or dead line does not differ; and largest share of bad lines: more are a pattern of the
scene or of a screen. In 683 images, most of them REAL, there is no such line."""

NEIGHBOUR_STEPS: IntArray = np.array([(v, u) for v in (-1, 0, 1) for u in (-1, 0, 1) if v or u])


def without_bad_pixels(grey: GreyImage) -> GreyImage:
    """Return `grey` with its bad lines replaced by the mean of both neighbours, and bad pixels by the median of their
    good neighbours; unchanged without any."""
    turned: GreyImage = grey.swapaxes(0, 1)
    repaired = _without_bad_rows(turned)
    grey = _without_bad_rows(grey if repaired is turned else repaired.T.copy())
    step = _evident(grey)
    if step is None:
        return grey
    out = grey.copy()
    for _ in range(REPAIR_ROUNDS):
        _repair(out, step)
    return out


def _without_bad_rows(grey: GreyImage) -> GreyImage:
    """Return `grey` with its bad rows replaced by the mean of both neighbours; unchanged without any."""
    if min(grey.shape) < 3:
        return grey
    rows = np.arange(1, len(grey) - 1)
    for across in SAMPLED_ACROSS:
        places = grey[:, grey.shape[1] // (2 * across) :: max(1, grey.shape[1] // across)].T.copy()
        # Slices, at first, take a tenth of the time of indices.
        every = len(rows) == len(grey) - 2
        lines = (slice(k, len(grey) - 2 + k) if every else rows - 1 + k for k in range(3))
        above, here, below = (places[:, of] for of in lines)
        least, most, step = cv2.min(above, below), cv2.max(above, below), SPAN_SHARE * float(np.ptp(places))
        bad = _hold(here >= most, EXTREME_SHARE) & _hold(cv2.subtract(here, most) > step, EVIDENT_SHARE)
        bad |= _hold(here <= least, EXTREME_SHARE) & _hold(cv2.subtract(least, here) > step, EVIDENT_SHARE)
        rows = rows[bad]
        if not 0 < len(rows) <= MAX_BAD_LINES * len(grey):
            return grey
    out = grey.copy()
    mean = 0.5 * grey[rows - 1] + 0.5 * grey[rows + 1]
    out[rows] = mean if grey.dtype == np.float32 else np.rint(mean)
    return out


def _hold(true: BoolArray, share: float) -> BoolArray:
    """Return which columns (N,) of `true` (M, N) are true in at least this share of the rows."""
    # np.count_nonzero takes three times as long; there are fewer than 2 SAMPLED_ACROSS places.
    return np.asarray(np.add.reduce(true, axis=0, dtype=np.uint8) >= share * len(true))


def _evident(grey: GreyImage) -> float | None:
    """Return the threshold on the difference of bad pixels from their neighbours, None if there are hardly any."""
    height, width = grey.shape
    stride = max(3, width * height // LOOKED_AT)
    first = 1 + (height - 3) % stride // 2
    count, span = front.bad_pixels(grey, first, stride, 0.0, SPAN_SHARE)
    if count < MIN_EVIDENT:
        return None
    above, here, below = (grey[first + k : height - 1 + k : stride].astype(np.float64) for k in (-1, 0, 1))
    rough = np.abs(here - 0.5 * above - 0.5 * below).ravel()
    # The difference of a pixel and the mean of two has a median of 0.6745 sqrt(1.5) sigma.
    sigma = float(np.partition(rough, len(rough) // 2)[len(rough) // 2]) / 0.826
    step = max(BAD_PIXEL_SIGMAS * sigma, SPAN_SHARE * span)
    return step if front.bad_pixels(grey, first, stride, step, 0.0)[0] >= MIN_EVIDENT else None


def _repair(image: GreyImage, step: float) -> None:
    """Replace the pixels that differ by `step` from their neighbours by the median of the good ones, IN PLACE."""
    height, width = image.shape
    row, column = np.nonzero(cv2.absdiff(image, cv2.medianBlur(image, 3)) > step)
    rows, columns = row[:, None] + NEIGHBOUR_STEPS[:, 0], column[:, None] + NEIGHBOUR_STEPS[:, 1]
    inside = (rows >= 0) & (rows < height) & (columns >= 0) & (columns < width)
    rows, columns = np.where(inside, rows, row[:, None]), np.where(inside, columns, column[:, None])
    own, around = image[row, column].astype(np.float32)[:, None], image[rows, columns].astype(np.float32)
    # Neighbours outside the image count as different.
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
