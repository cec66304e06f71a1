"""Convert radiance to grey levels: illumination, vignetting, gamma, sharpening, noise, quantisation, JPEG."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from rigkit.core.arrays import FloatArray
from rigkit.core.errors import InputError

SHARPEN_SIGMA_PX = 1.0
"""Blur of the unsharp mask, as camera firmware does it."""


@dataclass(frozen=True, eq=False, slots=True)
class Shadow:
    """A shadow with a straight, soft border.

    Attributes
    ----------
    angle_deg : direction in the image towards the dark side.
    offset : distance of the border from the centre, over half the image diagonal.
    softness : width of the penumbra (sigma), same unit.
    factor : fraction of the light in the shadow.
    """

    angle_deg: float = 30.0
    offset: float = 0.0
    softness: float = 0.05
    factor: float = 0.35


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class Photometry:
    """Illumination and sensor.

    Attributes
    ----------
    exposure : grey level (0 to 1) of reflectance 1 in the middle; above 1 whites saturate.
    vignetting : fraction of light lost in the image's corners (quadratic in the radius).
    gradient : (right, down) relative change of the light from the centre to the border.
    shadow : a shadow across the image, or None.
    gamma : exponent of the tone curve (1 linear, 1 / 2.2 for display).
    sharpen : amount of an unsharp mask.
    noise_levels : sigma of Gaussian noise, in grey levels of 8 bits whatever `bits` is.
    bits : 8 or 16.
    jpeg_quality : quality of a JPEG round trip, or None (8 bit only).
    """

    exposure: float = 0.95
    vignetting: float = 0.0
    gradient: tuple[float, float] = (0.0, 0.0)
    shadow: Shadow | None = None
    gamma: float = 1.0
    sharpen: float = 0.0
    noise_levels: float = 0.0
    bits: int = 8
    jpeg_quality: int | None = None

    def __post_init__(self) -> None:
        if self.bits not in (8, 16):
            raise InputError(f"photometry: bits must be 8 or 16, got {self.bits}")
        if self.jpeg_quality is not None and self.bits != 8:
            raise InputError("photometry: JPEG has 8 bits; set bits = 8 or jpeg_quality = None")
        if self.noise_levels < 0.0 or self.gamma <= 0.0 or self.exposure <= 0.0:
            raise InputError("photometry: noise_levels must not be negative, gamma and exposure must be positive")


def develop(
    radiance: FloatArray, photometry: Photometry, rng: np.random.Generator | None = None
) -> NDArray[np.uint8] | NDArray[np.uint16]:
    """Return the sensor image of `radiance` (height, width; 0 to 1).

    Raises InputError for noise without `rng`.
    """
    light = radiance * (photometry.exposure * _illumination(radiance.shape, photometry))
    if photometry.gamma != 1.0:
        light = np.clip(light, 0.0, None) ** photometry.gamma
    if photometry.sharpen:
        light = light + photometry.sharpen * (light - cv2.GaussianBlur(light, (0, 0), SHARPEN_SIGMA_PX))
    levels = 255.0 * light
    if photometry.noise_levels > 0.0:
        if rng is None:
            raise InputError("render: noise needs a random generator; pass rng=np.random.default_rng(seed)")
        levels = levels + photometry.noise_levels * rng.standard_normal(levels.shape, dtype=np.float32)
    if photometry.bits == 16:
        return np.clip(np.rint(levels * 257.0), 0, 65535).astype(np.uint16)
    image = np.clip(np.rint(levels), 0, 255).astype(np.uint8)
    if photometry.jpeg_quality is not None:
        _, data = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, photometry.jpeg_quality])
        image = np.asarray(cv2.imdecode(data, cv2.IMREAD_GRAYSCALE), dtype=np.uint8)
    return image


def _illumination(shape: tuple[int, ...], photometry: Photometry) -> FloatArray:
    """Return the relative illumination of every pixel (height, width)."""
    height, width = shape
    half = 0.5 * float(np.hypot(width, height))
    x = ((np.arange(width) - (width - 1) / 2.0) / half)[None, :]
    y = ((np.arange(height) - (height - 1) / 2.0) / half)[:, None]
    light = 1.0 - photometry.vignetting * (x**2 + y**2)
    right, down = photometry.gradient
    light = light * np.clip(1.0 + right * x * (2.0 * half / width) + down * y * (2.0 * half / height), 0.0, None)
    if photometry.shadow is not None:
        from scipy.special import ndtr

        s = photometry.shadow
        angle = np.radians(s.angle_deg)
        depth = (x * np.cos(angle) + y * np.sin(angle) - s.offset) / s.softness
        light = light * (1.0 - (1.0 - s.factor) * ndtr(depth))
    return np.asarray(light)
