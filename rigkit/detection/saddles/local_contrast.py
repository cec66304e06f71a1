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

MIDDLE, GAIN = 127.5, 50.0
"""Grey levels of the local mean, and of one local deviation."""

DARK_LEVEL, BRIGHT_LEVEL = 25.0, 205.0
"""Grey levels of the dark and the bright squares after stretching."""


def equalised(grey: GreyImage) -> FloatImage:
    """Return `grey` with equal local mean and deviation everywhere, in grey levels 0..255."""
    values = grey.astype(np.float32)
    window = WINDOW_PART * min(values.shape)
    off = values - cv2.GaussianBlur(values, (0, 0), window)
    deviation = np.sqrt(cv2.GaussianBlur(off * off, (0, 0), window))
    least = max(MIN_DEVIATION * float(deviation.max()), 1e-6)
    return np.asarray(np.clip(MIDDLE + GAIN * off / np.maximum(deviation, least), 0.0, 255.0), np.float32)


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
