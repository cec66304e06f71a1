"""Add the noise of the synthetic study: rotated directions, displaced corners."""

from __future__ import annotations

from enum import StrEnum

import numpy as np

from rigkit.core.arrays import FloatArray, Pixels
from rigkit.core.matches import DirectionPairs


class NoisyImages(StrEnum):
    """Which image of a pair is noisy. The paper does not say; in reality it is `BOTH`."""

    FIRST = "1"
    SECOND = "2"
    BOTH = "both"

    @property
    def which(self) -> tuple[bool, bool]:
        return (self is not NoisyImages.SECOND, self is not NoisyImages.FIRST)


def turn(vectors: FloatArray, angle_rad: FloatArray) -> FloatArray:
    """Return 2-vectors (..., 2) rotated by `angle_rad` (...)."""
    c, s = np.cos(angle_rad), np.sin(angle_rad)
    x, y = vectors[..., 0], vectors[..., 1]
    return np.stack([c * x - s * y, s * x + c * y], axis=-1)


def rotate_directions(
    directions: DirectionPairs, sigma_rad: float, rng: np.random.Generator, *, images: NoisyImages = NoisyImages.BOTH
) -> DirectionPairs:
    """Return the directions, each rotated by an independent normally distributed angle.

    The noise model of L. Hajder, "Affine Correspondences in Stereo Vision: Theory, Practice, and Limitations". It
    keeps lengths noise-free, which favours the estimators that use them.
    """
    shape = directions.valid.shape
    out = [directions.image1, directions.image2]
    for k, noisy in enumerate(images.which):
        if noisy and sigma_rad > 0.0:
            out[k] = turn(out[k], sigma_rad * rng.standard_normal(shape))
    return DirectionPairs(
        image1=out[0], image2=out[1], valid=directions.valid, scaled=directions.scaled, kinds=directions.kinds
    )


def corner_noise(
    pixels1: Pixels,
    pixels2: Pixels,
    sigma_px: float,
    rng: np.random.Generator,
    *,
    images: NoisyImages = NoisyImages.BOTH,
) -> tuple[Pixels, Pixels]:
    """Return corners (..., 2) of both images with independent normal noise of `sigma_px` per axis."""
    out = [np.asarray(pixels1, dtype=np.float64), np.asarray(pixels2, dtype=np.float64)]
    for k, noisy in enumerate(images.which):
        if noisy and sigma_px > 0.0:
            out[k] = out[k] + sigma_px * rng.standard_normal(out[k].shape)
    return out[0], out[1]
