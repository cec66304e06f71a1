"""How certain the centres of a grid's circles are: by the noise of pixels, and by what their shapes say of all else.

The residuals of a circle's pixels show too little of its error where neighbouring pixels share their noise (a picture
smoothed after it was taken), or print or light differ along the edge. They show too much where noise changes its sign
from pixel to pixel (JPEG), and where they are those of another blur (motion), the same on both sides. Whatever it is
changes how circles are slanted as much as where they lie, each in its sigmas for white noise; and what the slant should
be is known, for neighbours foretell it.
"""

from __future__ import annotations

from math import log

import numpy as np

from rigkit.core.arrays import FloatArray, IntArray
from rigkit.detection.circles.fit import MODEL_SIGMA_PX, CircleFit
from rigkit.detection.circles.local_map import MIN_SMOOTH

MAP_ERROR = 1.0
"""Error of a centre over that of its circle's size times the radius in distances: (n - 1) / 4 for the order n = 5 that
follows the polynomial's (`local_map`)."""
ODD_BY_NOISE = 3.8
"""Noise makes the sum of squares of three changes of shape so many times its usual one once in a hundred circles."""
WAVY_BY_NOISE = 2.5
"""Likewise the mean square of harmonics 3 to 6 of a circle's edge."""
SMOOTH_TERMS = 6
"""Of the surface beside which circles are slanted."""


def centre_sigmas(fit: CircleFit, label: IntArray, slope_gain: FloatArray | float, radius: float) -> FloatArray:
    """Return standard deviations (N,) of the centres of a grid's circles, px.

    By how much more slants scatter, or less, than white noise makes them, all are less sure, or more. What a single
    circle is off in size and slant, beyond that and beyond what all are (motion stretches them), shows the error of the
    map's first derivatives. At the rim, where it is not small, the map is foretold from one side, and what its
    polynomial leaves of order n in the distance t has second over first derivatives (n - 1) / t. A quarter of that,
    times the radius, moves the centre. What makes an edge wavy (dirt, a finger, print) moves it as much.

    Parameters
    ----------
    slope_gain : (N,) of the maps that were given to the fit (`PlaneMap`); 0 where they come from a camera.
    radius : in distances of neighbours.
    """
    size_px = np.sqrt(np.abs(np.linalg.det(fit.maps)))
    relative = fit.sigma_px / size_px
    typical = fit.growth_variance + (MODEL_SIGMA_PX / size_px)[:, None] ** 2
    typical = typical + 0.5 * (slope_gain * radius * relative)[:, None] ** 2
    odd = _without_smooth_part(fit.growth, label) ** 2
    more = _variance_over_white((odd / typical)[:, 1:])
    misshapen = np.maximum(odd.sum(axis=1) - ODD_BY_NOISE * more * typical.sum(axis=1), 0.0)
    wavy = (_without_smooth_part(fit.harmonics.reshape(len(label), -1), label) ** 2).mean(axis=1)
    uneven = np.maximum(wavy - WAVY_BY_NOISE * more * relative**2, 0.0)
    return np.asarray(np.sqrt(more * fit.sigma_px**2 + ((MAP_ERROR * radius) ** 2 * misshapen + uneven) * size_px**2))


def _variance_over_white(slants: FloatArray) -> float:
    """Return the variance of the centres over that by white noise, from the squares (N, 2) of how circles are slanted,
    each over its variance by white noise: 1 as far as chance may have made them differ."""
    free = len(slants) - SMOOTH_TERMS if len(slants) >= MIN_SMOOTH else len(slants) - 1
    # The mean of two squares of normal deviates has the median ln 2; that of N scatters by 1 / (ln 2 sqrt(N)) of it.
    times = float(np.median(slants.mean(axis=1))) / log(2.0) * len(slants) / free
    chance = times**2 / (free * log(2.0) ** 2)
    sure = 1.0 - chance / max((times - 1.0) ** 2, 1e-12)
    return 1.0 + max(sure, 0.0) * (times - 1.0)


def _without_smooth_part(values: FloatArray, label: IntArray) -> FloatArray:
    """Return what `values` (N, K) are beside a quadratic surface over the places: what all have, and what lens and blur
    change evenly, is no scatter. Beside their medians where there are few circles."""
    off = values - np.median(values, axis=0)
    if len(values) < MIN_SMOOTH:
        return off
    x, y = ((label - label.mean(axis=0)) / np.maximum(np.ptp(label, axis=0), 1)).T
    terms = np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], axis=1)
    return np.asarray(off - terms @ np.linalg.lstsq(terms, off, rcond=None)[0])
