"""Whether a saddle is a chessboard corner: the brightness on a ring around it.

Around a corner the brightness is the same on opposite sides and changes exactly twice in half a turn, and the corner
itself is as bright as the ring on average, whatever the angles, the blur and the slope of the light. Where it rises
(angle counted from u to v) lies line A, where it falls line B; so the ring gives the two line directions and the
polarity: which quadrants are bright.

Blur bends the borders of the quadrants near the corner, up to right angles in its middle, so the places where the ring
changes from dark to bright are not on the lines. What blur does to the harmonics of the angle is known, though: that of
order m of a corner blurred by a Gaussian of sigma s shrinks by R_m(r / s) on the ring of radius r (Hankel transform),

    y = r^2 / (2 s^2),  R_2 = 1 - (1 - e^-y) / y,  R_4 = 1 - (4 + 2 e^-y) / y + 6 (1 - e^-y) / y^2.

Two bright quadrants of angle b have harmonics 2 and 4 of ratio cos b. Harmonic 2 on a ring of half the radius tells y,
harmonics 2 and 4 of the ring the angle, and the phase of harmonic 2 where the middle of the bright quadrants is.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass

import numpy as np

from rigkit.core.arrays import BoolArray, FloatArray
from rigkit.detection.saddles.response import FloatImage, sample
from rigkit.kernels.front import HALF, RingRules

__all__ = ["Rings", "arm_vectors", "may_be_corners", "read_rings", "ring_rules"]

CIRCLE = np.stack([f(np.arange(2 * HALF) * (np.pi / HALF)) for f in (np.cos, np.sin)], axis=-1).astype(np.float32)
"""Where they lie on a ring of radius 1, (2 HALF, 2)."""

MAX_ODD = 0.25
"""Largest energy of the part that changes sign on opposite sides, relative to the part that does not. Of the corners of
boards, noisy, blurred, or crossed by a shadow's edge, 0.05 % show more; of what noise and texture make, 20 %."""

MAX_CENTRE = 0.16
"""Largest difference of the centre from the mean of the ring, relative to the contrast. Rings inside the four squares
show less than 0.06; more where they reach beyond, which spoils the directions as well, and between dots or letters."""

QUICK, QUICK_ODD, QUICK_CENTRE, QUICK_SHARP = 4, 0.5, 0.6, 1.12
"""Every so many samples tell most of what is no corner, at a quarter of the cost: the energy of the odd part relative
to that of the even part, the centre off the mean relative to its deviation, the response relative to its variance. Of
29157 rings that pass the other tests, in rendered and real images, two are lost; of those of noise and texture two in
three need not be read."""

LARGEST_GAIN = 8.0
"""Largest R_2 / R_4 that is made up for: beyond it, in the middle of a strong blur, harmonic 4 is only noise."""

MAX_COSINE = 0.99
"""Bound of cos b: flatter quadrants than 8 degrees are noise."""

GAINS = 64
"""Entries of the table of R_2(r / s) / R_4(r / s) over R_2(r / 2 s) / R_2(r / s), which goes from 1/4 to 1."""

HARMONICS = [np.exp(-1j * m * np.arange(HALF) * (np.pi / HALF)).astype(np.complex64) for m in (2, 4)]


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


def may_be_corners(image: FloatImage, pixels: FloatArray, radius_px: float, response: FloatImage) -> BoolArray:
    """Return which of `pixels` (N, 2), where the saddle response is `response` (N,), are worth to be read a ring of."""
    places = pixels.astype(np.float32)
    values = sample(image, places[:, None, :] + np.float32(radius_px) * CIRCLE[::QUICK])
    one, other = np.split(values, 2, axis=1)
    even = 0.5 * (one + other)
    mean = even.mean(axis=1)
    variance = even.var(axis=1)
    odd = 0.25 * ((one - other) ** 2).mean(axis=1)
    off = np.abs(sample(image, places) - mean)
    possible = (
        (odd < QUICK_ODD * variance) & (off**2 < QUICK_CENTRE**2 * variance) & (response < QUICK_SHARP * variance)
    )
    return np.asarray(possible, dtype=np.bool_)


def read_rings(
    image: FloatImage,
    pixels: FloatArray,
    radius_px: FloatArray | float,
    max_odd: float = MAX_ODD,
    max_centre: float = MAX_CENTRE,
) -> Rings:
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
    symmetric = (odd**2).sum(axis=1) < max_odd * (spread**2).sum(axis=1)
    balanced = np.abs(sample(image, pixels) - mean) < max_centre * (high - low)
    above = even > middle[:, None]
    valid = symmetric & balanced & (np.count_nonzero(~above & np.roll(above, -1, axis=1), axis=1) == 1)
    angles = np.zeros((len(pixels), 2))
    angles[valid] = _angles(image, pixels[valid], radius[valid], even[valid])
    return Rings(angles, contrast, valid)


def _angles(image: FloatImage, pixels: FloatArray, radius: FloatImage, even: FloatImage) -> FloatArray:
    """Return the angles of lines A and B (N, 2) from the `even` parts (N, HALF) of rings of `radius` (N,)."""
    second, fourth = (even @ wave for wave in HARMONICS)
    inner = sample(image, pixels[:, None, :].astype(np.float32) + 0.5 * radius[:, None, None] * CIRCLE[::2])
    size = np.maximum(np.abs(second), 1e-20)
    phase = second / size
    nearer = (0.5 * (inner[:, : HALF // 2] + inner[:, HALF // 2 :])) @ HARMONICS[0][::2]
    gain = np.interp(2.0 * (nearer * phase.conj()).real / size, np.linspace(0.25, 1.0, GAINS), _gains())
    cosine = gain * (fourth * phase.conj() ** 2).real / size
    half = 0.5 * np.arccos(np.clip(cosine, -MAX_COSINE, MAX_COSINE))
    first = (-0.5 * np.angle(phase) - half) % np.pi
    return np.stack([first, first + 2.0 * half], axis=-1)


@functools.cache
def _gains() -> FloatArray:
    """Return R_2 / R_4 where harmonic 2 on the inner ring, relative to that on the ring, is 1/4 to 1 in GAINS steps."""
    y = np.geomspace(1e-2, 1e4, 2000)
    fall = np.exp(-y)
    second, quarter = 1.0 - (1.0 - fall) / y, 1.0 - (1.0 - np.exp(-0.25 * y)) / (0.25 * y)
    fourth = 1.0 - (4.0 + 2.0 * fall) / y + 6.0 * (1.0 - fall) / y**2
    return np.minimum(np.interp(np.linspace(0.25, 1.0, GAINS), quarter / second, second / fourth), LARGEST_GAIN)


@functools.cache
def ring_rules(max_odd: float = MAX_ODD, max_centre: float = MAX_CENTRE) -> RingRules:
    """Return the constants of this module for the kernels."""
    return RingRules.make(
        CIRCLE,
        _gains(),
        most_odd=max_odd,
        most_centre=max_centre,
        most_cosine=MAX_COSINE,
        quick_odd=QUICK_ODD,
        quick_centre=QUICK_CENTRE,
        quick_sharp=QUICK_SHARP,
    )


def arm_vectors(angles: FloatArray) -> FloatArray:
    """Return the unit vectors of the four arms (N, 4, 2), with growing angle: A, B, -A, -B."""
    two = np.stack([np.cos(angles), np.sin(angles)], axis=-1)
    return np.concatenate([two, -two], axis=1)
