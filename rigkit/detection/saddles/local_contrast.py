"""Images with a range of brightness far larger than that of a board's squares: thermal images, scenes against the
light.

In a thermal image of 16 bits a person may take most of the range, and a board a hundredth. Such an image is searched
again with its local mean subtracted and its local deviation normalised; then the image is stretched to the range of the
boards found.
"""

from __future__ import annotations

import cv2
import numpy as np

from rigkit.core.arrays import FloatArray
from rigkit.detection.saddles.response import FloatImage, GreyImage, sample

WINDOW_PART = 1.0 / 16.0
"""Standard deviation of the window over the image's shorter side: boards with squares of a fortieth to a sixth of it
keep their contrast."""

MIN_DEVIATION = 0.02
"""Smallest local deviation that is normalised, over the largest: smaller ones are noise of uniform areas."""

SAMPLES_A_WINDOW = 16.0
"""Samples of the local means in one standard deviation of the window, between which they are interpolated to a
two-thousandth of their change: at every pixel of an image of 8 MP they take 22 s."""

MIDDLE, GAIN = 127.5, 50.0
"""Grey levels of the local mean, and of one local deviation."""

DARK_LEVEL, BRIGHT_LEVEL = 25.0, 205.0
"""Grey levels of the dark and the bright squares after stretching."""


def equalised(grey: GreyImage) -> FloatImage:
    """Return `grey` with equal local mean and deviation everywhere, in grey levels 0..255."""
    values = grey.astype(np.float32)
    window = WINDOW_PART * min(values.shape)
    off = values - _local_mean(values, window)
    deviation = np.sqrt(_local_mean(off * off, window))
    least = max(MIN_DEVIATION * float(deviation.max()), 1e-6)
    return np.asarray(np.clip(MIDDLE + GAIN * off / np.maximum(deviation, least), 0.0, 255.0), np.float32)


def _local_mean(values: FloatImage, window: float) -> FloatImage:
    """Return the means of `values` in a Gaussian window with this standard deviation (px)."""
    height, width = values.shape
    step = max(1.0, window / SAMPLES_A_WINDOW)
    small = cv2.resize(values, (round(width / step), round(height / step)), interpolation=cv2.INTER_AREA)
    means = cv2.GaussianBlur(small, (0, 0), window * small.shape[1] / width, sigmaY=window * small.shape[0] / height)
    return np.asarray(cv2.resize(means, (width, height), interpolation=cv2.INTER_LINEAR), np.float32)


def stretched(grey: GreyImage, boards: list[FloatArray]) -> GreyImage:
    """Return `grey` scaled linearly, 0..255, with the squares of `boards` at DARK_LEVEL and BRIGHT_LEVEL.

    `boards` : (R, C, 2) pixels of the corners of each, NaN where unknown. Without boards the image is unchanged.
    """
    corners = [(b[:-1, :-1] + b[:-1, 1:] + b[1:, :-1] + b[1:, 1:]).reshape(-1, 2) for b in boards]
    middles = 0.25 * np.concatenate([*corners, np.zeros((0, 2))])
    middles = middles[np.isfinite(middles).all(axis=1)]
    if not len(middles):
        return grey
    low, high = np.quantile(sample(grey, middles), (0.1, 0.9))
    gain = (BRIGHT_LEVEL - DARK_LEVEL) / max(float(high - low), 1e-6)
    values = (grey.astype(np.float32) - np.float32(low)) * np.float32(gain) + np.float32(DARK_LEVEL)
    return np.asarray(np.clip(values, 0.0, 255.0), np.float32)
