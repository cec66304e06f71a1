"""Whether a saddle is a chessboard corner: the brightness on a ring around it.

Around a corner the brightness is the same on opposite sides and changes exactly twice in half a turn, and the corner
itself is as bright as the ring on average, whatever the angles, the blur and the slope of the light. Where it rises
(angle from u to v) lies line A, where it falls line B; so the ring gives the two line directions and the
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

import numpy as np

from rigkit.core.arrays import FloatArray
from rigkit.kernels.front import HALF, RingRules

CIRCLE = np.stack([f(np.arange(2 * HALF) * (np.pi / HALF)) for f in (np.cos, np.sin)], axis=-1).astype(np.float32)
"""Where they lie on a ring of radius 1, (2 HALF, 2)."""

MAX_ODD = 0.25
"""Largest energy of the part that changes sign on opposite sides, relative to the part that does not. Of the corners of
boards, noisy, blurred, or crossed by a shadow's edge, 0.05 % show more; of what noise and texture make, 20 %."""

MAX_CENTRE = 0.16
"""Largest difference of the centre from the mean of the ring, relative to the contrast. Rings inside the four squares
show less than 0.06; more where they reach beyond, which spoils the directions as well, and between dots or letters."""

EVEN_ODD, EVEN_CENTRE = 0.05, 0.5
"""The same of the centre where so little changes sign on opposite sides: motion that is not along one of a corner's
lines smears bright or dark squares into its middle, and leaves it as even as it was; so do squares that run over into
others (too much light, ink that spreads), up to half of the contrast. What covers corners or stands beside them does
not."""

QUICK_ODD, QUICK_CENTRE, QUICK_EVEN_CENTRE, QUICK_SHARP = 0.5, 0.6, 1.2, 1.12
"""Every fourth of the samples tells most of what is no corner, at a quarter of the cost: the energy of the odd part
relative to that of the even part, the centre off the mean relative to its deviation, the response relative to its
variance. Of 29157 rings that pass the other tests, in rendered and real images, two are lost; of those of noise and
texture two in three need not be read."""

LARGEST_GAIN = 8.0
"""Largest R_2 / R_4 that is made up for: beyond it, in the middle of a strong blur, harmonic 4 is only noise."""

MAX_COSINE = 0.99
"""Bound of cos b: flatter quadrants than 8 degrees are noise."""

GAINS = 64
"""Entries of the table of R_2(r / s) / R_4(r / s) over R_2(r / 2 s) / R_2(r / s), which goes from 1/4 to 1."""


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
    return RingRules.of(
        circle=CIRCLE,
        gains=_gains(),
        max_odd=max_odd,
        max_centre=max_centre,
        even_odd=EVEN_ODD,
        even_centre=max(EVEN_CENTRE, max_centre),
        max_cosine=MAX_COSINE,
        quick_odd=QUICK_ODD,
        quick_centre=QUICK_CENTRE,
        quick_even=QUICK_EVEN_CENTRE,
        quick_sharp=QUICK_SHARP,
    )


def line_vectors(angles: FloatArray) -> FloatArray:
    """Return the unit vectors of the lines A and B (N, 2, 2); the other two arms of a corner point the other way."""
    return np.stack([np.cos(angles), np.sin(angles)], axis=-1)
