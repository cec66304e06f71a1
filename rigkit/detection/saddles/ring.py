"""The ring test: whether a saddle is a chessboard corner, by the brightness on a ring around it.

Around a corner the brightness is equal on opposite sides and changes exactly twice in half a turn. The centre has the
mean brightness of the ring, for all angles, blurs and gradients of the light. Line A is where brightness rises (angle
from u to v), line B where it falls; the ring thus gives both directions and the polarity.

Blur bends the borders of the quadrants near the corner, so that the transitions on the ring are not on the lines. Its
effect on the angular harmonics is known: on the ring of radius r a Gaussian blur of standard deviation s multiplies the
harmonic of order m by R_m(r / s) (Hankel transform),

    y = r^2 / (2 s^2),  R_2 = 1 - (1 - e^-y) / y,  R_4 = 1 - (4 + 2 e^-y) / y + 6 (1 - e^-y) / y^2.

Two bright quadrants of angle b have harmonics 2 and 4 with the ratio cos b. Harmonic 2 on a second ring of half the
radius determines y, harmonics 2 and 4 the angle b, and the phase of harmonic 2 the middle of the bright quadrants.
"""

from __future__ import annotations

import functools

import numpy as np

from rigkit.core.arrays import FloatArray
from rigkit.kernels.front import HALF, RingRules

CIRCLE = np.stack([f(np.arange(2 * HALF) * (np.pi / HALF)) for f in (np.cos, np.sin)], axis=-1).astype(np.float32)
"""Sample positions on a ring of radius 1, (2 HALF, 2)."""

MAX_ODD = 0.25
"""Largest energy of the odd part (opposite signs on opposite sides) over that of the even part. 0.05 % of the corners
of boards, noisy, blurred, or crossed by a shadow edge, have more; of false corners of noise and texture 20 %."""

MAX_CENTRE = 0.16
"""Largest difference of the centre from the mean of the ring, over the contrast. It is less than 0.06 for rings within
the four squares, and larger for rings that extend beyond, whose directions are wrong too, or between dots or
letters."""

EVEN_ODD, EVEN_CENTRE = 0.05, 0.5
"""The bound of the centre is larger, EVEN_CENTRE, if the odd part is at most EVEN_ODD. Motion across both lines, or
squares that merge with others (saturation, spreading ink), change the centre by up to half of the contrast but keep the
symmetry; occlusions do not."""

QUICK_ODD, QUICK_CENTRE, QUICK_EVEN_CENTRE, QUICK_SHARP = 0.5, 0.6, 1.2, 1.12
"""Bounds of a quick test on every fourth sample: odd over even energy, difference of the centre over the deviation, and
response over the variance. Of 29157 rings that pass the full test, in RENDERED and REAL images, it rejects two; of
those of noise and texture it rejects two of three."""

LARGEST_GAIN = 8.0
"""Largest R_2 / R_4 that is corrected: beyond it, for strong blur, harmonic 4 is noise."""

MAX_COSINE = 0.99
"""Largest cos b: quadrants of less than 8 degrees are noise."""

GAINS = 64
"""Entries of the table of R_2(r / s) / R_4(r / s) over R_2(r / 2 s) / R_2(r / s), which goes from 1/4 to 1."""


@functools.cache
def _gains() -> FloatArray:
    """Return R_2 / R_4 for GAINS ratios, from 1/4 to 1, of harmonic 2 on the inner ring to that on the ring."""
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
    """Return the unit vectors of the lines A and B (N, 2, 2); the other two arms of a corner are opposite.

    They are as exact as the ring, in float32, whose functions are vectorised.
    """
    fine = angles.astype(np.float32)
    return np.stack([np.cos(fine), np.sin(fine)], axis=-1).astype(np.float64)
