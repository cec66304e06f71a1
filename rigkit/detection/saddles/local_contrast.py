"""Images whose parts differ in brightness by far more than a board's squares do: heat images, scenes against the light.

Of 16 bits a person in front of a board takes most in a heat image, and the squares of the board a hundredth. Such an
image is searched once more with its local mean taken away and its local deviation made the same everywhere.
"""

from __future__ import annotations

import cv2
import numpy as np

from rigkit.detection.saddles.response import FloatImage, GreyImage

__all__ = ["equalised"]

WINDOW_PART = 1.0 / 16.0
"""Standard deviation of the window, as a part of the image's shorter side: boards with squares of a fortieth to a sixth
of it keep their contrast."""

MIN_DEVIATION = 0.02
"""Smallest local deviation that is made up for, as a part of the largest: below is the noise of empty walls."""

MIDDLE, GAIN = 127.5, 50.0
"""Grey levels of the local mean, and of one local deviation."""


def equalised(grey: GreyImage) -> FloatImage:
    """Return `grey` with equal mean and deviation everywhere, in grey levels 0..255."""
    values = grey.astype(np.float32)
    window = WINDOW_PART * min(values.shape)
    off = values - cv2.GaussianBlur(values, (0, 0), window)
    deviation = np.sqrt(cv2.GaussianBlur(off * off, (0, 0), window))
    least = max(MIN_DEVIATION * float(deviation.max()), 1e-6)
    return np.asarray(np.clip(MIDDLE + GAIN * off / np.maximum(deviation, least), 0.0, 255.0), np.float32)
