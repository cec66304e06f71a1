"""What a calibrated lens may still be off by: smooth displacements over its image, in families of like shape.

What a calibration leaves is mostly along the radius and alike all around (a curve too stiff, a focal length), then of a
lens whose axis or plane is tilted (of first order in the azimuth; D. C. Brown, "Decentering Distortion of Lenses",
1966), then anything smooth. The part that is a rotation of the camera is kept apart where the pose is free to follow
it: no pair of images shows it then. A pose that is told does not follow, and pairs are off by that part too.

These are not the displacements with which calibrations count (`kernels.departures`), though they were tried: alone they
leave poses twice as far off, for pairs show ripples that no such polynomial is. Beside the waves over the image they do
as well, but state poses too surely, perhaps as powers of the radius are large at its rim alone, where boards hardly are
and pairs are many (docs/pages/accuracy-clouds.md, "Tried and left out").
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from rigkit.cameras.base import Camera, image_center
from rigkit.core.arrays import FloatArray, IntArray, Pixels
from rigkit.geometry.rotation import cross

RADIAL_WAVES = 4
TILTED_WAVES = 2
MAX_WAVES = 4
"""Half waves of a family: along the radius, and over the image, both ways together. Narrower ones are noise to
a pose."""
IMAGE_GRID = 24
"""Pixels to either side that say what a displacement is over the image."""


class ErrorModes(NamedTuple):
    """Displacements that a lens may be off by, each of unit standard deviation in a family of 1 px rms over the image.

    Attributes
    ----------
    displacements : (N, 2, K) px at the pixels that were asked for.
    turns : (3, K) rad by which the camera turns with each mode; the displacements are without it. Zero where they are
        with it.
    families : (K,) 0 along the radius, 1 of a tilt, 2 anything smooth.
    """

    displacements: FloatArray
    turns: FloatArray
    families: IntArray


def error_modes(camera: Camera, pixels: Pixels, *, free_to_turn: bool) -> ErrorModes:
    """Return the modes at pixels (N, 2), which all have rays and tell how much of the image is used.

    Of a camera that is not `free_to_turn` they are with what a turn of it does to the image.
    """
    axis, valid = camera.project(np.array([0.0, 0.0, 1.0]))
    centre = axis if valid else image_center(camera.size_px)
    radius = float(np.linalg.norm(pixels - centre, axis=1).max())
    sides = [
        np.linspace(max(c - radius, 0.0), min(c + radius, n - 1.0), IMAGE_GRID)
        for c, n in zip(centre, camera.size_px, strict=True)
    ]
    grid = np.stack(np.meshgrid(*sides), axis=-1).reshape(-1, 2)
    grid = grid[camera.unproject(grid)[1] & (np.linalg.norm(grid - centre, axis=1) <= radius)]
    count = len(grid)
    everywhere = np.concatenate([grid, pixels])
    modes, families = _modes(everywhere, centre, radius, camera.size_px)
    by_turn = _by_turn(camera, everywhere)
    flat = modes[:count].reshape(2 * count, -1)
    turns: FloatArray = np.zeros((3, len(families)))
    if free_to_turn:
        turns = np.asarray(np.linalg.lstsq(by_turn[:count].reshape(2 * count, 3), flat, rcond=None)[0], np.float64)
    modes -= by_turn @ turns
    size = np.sqrt(np.bincount(families, weights=np.mean(np.sum(modes[:count] ** 2, axis=1), axis=0)))[families]
    return ErrorModes(modes[count:] / size, turns / size, families)


def _modes(pixels: Pixels, centre: FloatArray, radius: float, size_px: tuple[int, int]) -> tuple[FloatArray, IntArray]:
    """Return displacements (N, 2, K) and their families; the variance falls with the wave number."""
    away = pixels - centre
    distance = np.linalg.norm(away, axis=1)
    outwards = away / np.maximum(distance, 1e-9)[:, None]
    around = np.stack([-outwards[:, 1], outwards[:, 0]], axis=1)
    x = distance[:, None] / radius
    number = np.arange(max(RADIAL_WAVES, TILTED_WAVES))
    falling = np.cos(np.pi * number * x) / np.sqrt(1.0 + number**2)
    radial = [outwards[:, :, None] * (x * falling[:, :RADIAL_WAVES])[:, None, :]]
    bent = x**2 * falling[:, :TILTED_WAVES]
    tilted = [
        to[:, :, None] * (azimuth[:, None] * bent)[:, None, :] for to in (outwards, around) for azimuth in outwards.T
    ]
    waves = _smooth_waves(pixels, size_px)
    smooth = [axis[:, None] * waves[:, None, :] for axis in np.eye(2)]
    each = [radial, tilted, smooth]
    families = np.repeat(np.arange(3), [sum(part.shape[2] for part in parts) for parts in each])
    return np.concatenate([part for parts in each for part in parts], axis=2), families


def _smooth_waves(pixels: Pixels, size_px: tuple[int, int]) -> FloatArray:
    """Return cosines (N, W) over an image at pixels (N, 2), times the root of a variance that falls with their wave
    number: a wide bowl is likelier than ripples."""
    number = np.arange(MAX_WAVES + 1)
    along, down = (np.cos(np.pi * number * (x[:, None] + 0.5) / s) for x, s in zip(pixels.T, size_px, strict=True))
    i, j = np.nonzero(number[:, None] + number <= MAX_WAVES)
    return np.asarray(along[:, i] * down[:, j] / np.sqrt(1.0 + i**2 + j**2))


def _by_turn(camera: Camera, pixels: Pixels) -> FloatArray:
    """Return displacements (N, 2, 3) px by a rotation of the camera."""
    rays, _ = camera.unproject(pixels)
    by_turn = np.stack([cross(axis, rays) for axis in np.eye(3)], axis=-1)
    return np.asarray(np.linalg.pinv(camera.ray_jacobian(pixels)) @ by_turn)
