"""Simulate a camera's exposure, vignetting, glare and noise, and a webcam's image processing."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np

from rigkit.core.arrays import FloatArray
from traced.captures import Exposure

BRIGHT = 0.8
"""The 97th percentile of a picture is exposed to so much of the full well."""
BAYER_RESPONSE = (0.6, 1.0, 0.5)
"""Of red, green and blue pixels to white light."""
SHARPENING, SHARPENED_PX = 0.8, 1.2
"""How much of what a blur of this sigma takes away is added once more."""
JPEG_QUALITY = 80
GLARE_PART, GLARE_AT = 0.35, (0.7, 0.25)
"""Radius of the glare in parts of the picture's width, and where it lies in parts of its sides."""


def develop(light: FloatArray, exposure: Exposure, rng: np.random.Generator) -> Any:
    """Return the 8-bit sRGB picture that a sensor with shot and read noise makes of the light."""
    seen = _through_lens(light * (BRIGHT / np.percentile(light, 97.0)), exposure)
    part = np.clip(seen, 0.0, 1.5)
    if not exposure.webcam:
        return _coded(_counted(part, exposure, rng))
    rows, columns = np.indices(light.shape) % 2
    channel = rows + columns  # Red in even rows and columns, blue in odd ones, green elsewhere.
    response = np.array(BAYER_RESPONSE)
    counted = _counted(part * response[channel], exposure, rng)
    raw = np.round(65535.0 * np.clip(counted / response[channel], 0.0, 1.0)).astype(np.uint16)
    # OpenCV names the four pixels after those of the second row and column.
    colours = cv2.cvtColor(raw, cv2.COLOR_BayerBG2BGR).astype(np.float64) / 65535.0
    picture = _coded(colours).astype(np.float64)
    picture += SHARPENING * (picture - cv2.GaussianBlur(picture, (0, 0), SHARPENED_PX))
    return np.clip(np.round(picture), 0, 255).astype(np.uint8)


def _through_lens(part: FloatArray, exposure: Exposure) -> FloatArray:
    """Return the light that is left of `part` towards the corners, with the glare that a lamp makes in the lens."""
    height, width = part.shape
    y, x = np.indices(part.shape)
    squared = ((x - width / 2.0) ** 2 + (y - height / 2.0) ** 2) / (0.25 * (width**2 + height**2))
    away = np.hypot(x - GLARE_AT[0] * width, y - GLARE_AT[1] * height) / (GLARE_PART * width)
    return np.asarray(part * (1.0 - exposure.vignetting * squared) + exposure.glare * np.exp(-(away**2)))


def _counted(part: FloatArray, exposure: Exposure, rng: np.random.Generator) -> FloatArray:
    electrons = rng.poisson(part * exposure.full_well) + rng.normal(0.0, exposure.read_electrons, part.shape)
    return np.clip(electrons / exposure.full_well, 0.0, 1.0)


def _coded(x: FloatArray) -> Any:
    """Return linear values 0 to 1 as sRGB, 8 bits."""
    return np.round(255.0 * np.where(x <= 0.0031308, 12.92 * x, 1.055 * x ** (1.0 / 2.4) - 0.055)).astype(np.uint8)
