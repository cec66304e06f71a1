"""Whether a saddle is a chessboard corner: the brightness on a ring around it.

Around a corner the brightness is the same on opposite sides and changes exactly twice in half a turn, and the corner
itself is as bright as the ring on average, whatever the angles, the blur and the slope of the light. Where it rises
(angle counted from u to v) lies line A, where it falls line B; so the ring gives the two line directions and the
polarity: which quadrants are bright.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rigkit.arrays import BoolArray, FloatArray
from rigkit.corners.response import FloatImage, sample

__all__ = ["Rings", "arm_vectors", "read_rings"]

HALF = 16
"""Samples in half a turn."""

CIRCLE = np.stack([f(np.arange(2 * HALF) * (np.pi / HALF)) for f in (np.cos, np.sin)], axis=-1).astype(np.float32)
"""Where they lie on a ring of radius 1, (2 HALF, 2)."""

MAX_ODD = 0.35
"""Largest energy of the part that changes sign on opposite sides, relative to the part that does not."""

MAX_CENTRE = 0.16
"""Largest difference of the centre from the mean of the ring, relative to the contrast. Rings inside the four squares
show less than 0.06; more where they reach beyond, which spoils the directions as well, and between dots or letters."""


@dataclass(frozen=True, eq=False, slots=True)
class Rings:
    """What the rings around N points say.

    Attributes
    ----------
    angles : (N, 2) rad. Line A (dark to bright with growing angle) in [0, pi), line B (bright to dark) in (A, A + pi).
    contrast : (N,) bright minus dark, grey levels.
    valid : (N,) looks like a chessboard corner; the other values are undefined elsewhere.
    """

    angles: FloatArray
    contrast: FloatArray
    valid: BoolArray


def read_rings(image: FloatImage, pixels: FloatArray, radius_px: FloatArray | float) -> Rings:
    """Return what rings of `radius_px` (scalar or (N,)) around `pixels` (N, 2) of `image` look like."""
    radius = np.broadcast_to(np.asarray(radius_px, np.float32), pixels.shape[:1])
    values = sample(image, pixels[:, None, :].astype(np.float32) + radius[:, None, None] * CIRCLE)
    even = 0.5 * (values[:, :HALF] + values[:, HALF:])
    odd = 0.5 * (values[:, :HALF] - values[:, HALF:])
    low, high = even.min(axis=1), even.max(axis=1)
    contrast = (high - low).astype(np.float64)
    middle = 0.5 * (low + high)
    mean = even.mean(axis=1)
    spread = even - mean[:, None]
    symmetric = (odd**2).sum(axis=1) < MAX_ODD * (spread**2).sum(axis=1)
    balanced = np.abs(sample(image, pixels) - mean) < MAX_CENTRE * (high - low)
    above = even > middle[:, None]
    following = np.roll(above, -1, axis=1)
    rising, falling = ~above & following, above & ~following
    valid = symmetric & balanced & (rising.sum(axis=1) == 1) & (contrast > 0.0)
    angle_a, angle_b = (_crossing(even, middle, where) for where in (rising, falling))
    angle_a %= np.pi
    angle_b = angle_a + (angle_b - angle_a) % np.pi
    return Rings(np.stack([angle_a, angle_b], axis=-1), contrast, valid)


def _crossing(even: NDArray[np.floating], middle: NDArray[np.floating], where: BoolArray) -> FloatArray:
    """Return the angle at which each row of `even` passes `middle` in the interval marked by `where` (the first)."""
    row = np.arange(len(even))
    start = where.argmax(axis=1)
    here, there = even[row, start], even[row, (start + 1) % HALF]
    step = np.where(there == here, 1.0, there - here)
    angle: FloatArray = (start + np.clip((middle - here) / step, 0.0, 1.0)) * (np.pi / HALF)
    return angle


def arm_vectors(angles: FloatArray) -> FloatArray:
    """Return the unit vectors of the four arms (N, 4, 2), with growing angle: A, B, -A, -B."""
    two = np.stack([np.cos(angles), np.sin(angles)], axis=-1)
    return np.concatenate([two, -two], axis=1)
