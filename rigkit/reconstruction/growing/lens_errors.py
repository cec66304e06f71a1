"""Model the remaining errors of a calibrated lens: smooth displacements over its image, in three families.

Calibration errors are mostly radial and rotationally symmetric (a too stiff curve, the focal length), then those of a
tilted lens or sensor (first order in the azimuth; D. C. Brown, "Decentering Distortion of Lenses", 1966), then any
smooth displacement. If the pose is free, the part equal to a rotation of the camera is separated, because no image pair
shows it. A fixed pose does not absorb that part, so that it displaces the pairs.

The displacements of calibrations (`kernels.departures`) were tried instead: alone they double the pose error, because
pairs show ripples that such polynomials do not have. Together with the waves over the image the pose is as accurate,
but its covariance too small (docs/pages/accuracy-clouds.md, "Tried and left out").
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
"""Half waves of each family, along the radius or in both image directions together. Shorter ones do not affect a
pose."""
IMAGE_GRID = 24
"""Pixels along each side of the grid over which displacements are normalised."""


class ErrorModes(NamedTuple):
    """Modes of lens errors with unit standard deviation, scaled so that each family has 1 px RMS over the image.

    Attributes
    ----------
    displacements : (N, 2, K) px at the given pixels.
    turns : (3, K) rad, rotation of the camera that was removed from each mode; zero if none was.
    families : (K,) 0 radial, 1 tilt, 2 smooth.
    """

    displacements: FloatArray
    turns: FloatArray
    families: IntArray


def error_modes(camera: Camera, pixels: Pixels, *, free_to_turn: bool) -> ErrorModes:
    """Return the modes at pixels (N, 2), which must have rays; they determine the used radius of the image.

    If the camera is `free_to_turn`, the rotation of the camera closest to each mode is removed.
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
    """Return displacements (N, 2, K) and their families; the variance decreases with the wave number."""
    offset = pixels - centre
    distance = np.linalg.norm(offset, axis=1)
    outwards = offset / np.maximum(distance, 1e-9)[:, None]
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
    """Return cosines (N, W) over an image at pixels (N, 2), times a standard deviation that decreases with their wave
    number."""
    number = np.arange(MAX_WAVES + 1)
    along, down = (np.cos(np.pi * number * (x[:, None] + 0.5) / s) for x, s in zip(pixels.T, size_px, strict=True))
    i, j = np.nonzero(number[:, None] + number <= MAX_WAVES)
    return np.asarray(along[:, i] * down[:, j] / np.sqrt(1.0 + i**2 + j**2))


def _by_turn(camera: Camera, pixels: Pixels) -> FloatArray:
    """Return displacements (N, 2, 3) px by a rotation of the camera."""
    rays, _ = camera.unproject(pixels)
    by_turn = np.stack([cross(axis, rays) for axis in np.eye(3)], axis=-1)
    return np.asarray(np.linalg.pinv(camera.ray_jacobian(pixels)) @ by_turn)
