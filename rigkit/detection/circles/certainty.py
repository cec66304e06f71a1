"""The standard deviations of the centres of a grid's circles, from pixel noise and from the scatter of their shapes.

The residuals of a circle's pixels underestimate its error if neighbouring pixels share their noise (an image smoothed
after it was taken), or if print or light vary along the edge. They overestimate it if noise alternates from pixel to
pixel (JPEG), or if they are due to another blur (motion), which is symmetric. All of these change the slants of circles
as much as their centres, relative to their standard deviations for white noise, and slants are predicted by neighbours.
"""

from __future__ import annotations

from math import log

import numpy as np

from rigkit.core.arrays import FloatArray, IntArray
from rigkit.detection.circles.fit import MODEL_SIGMA_PX, CircleFit
from rigkit.detection.circles.local_map import MIN_SMOOTH

ODD_BY_NOISE = 3.8
"""Ratio of the sum of squares of three changes of shape to its expectation that noise exceeds for 1 % of circles."""
WAVY_BY_NOISE = 2.5
"""The same for the mean square of harmonics 3 to 6 of a circle's edge."""
MOVED_BY_NOISE = 4.6
"""The same for the squared move of a centre by the gradient of added light."""
ERROR_PER_MOVE = 2.3
"""Error of a centre over its move by added light: 2.0 to 2.4 where glare clips the paper, 0.6 to 1.1 elsewhere
(RENDERED, twelve regular and hexagonal grids, correlations of 0.8 to 0.99)."""
SMOOTH_TERMS = 6
"""Number of terms of the surface that is subtracted from slants."""


def centre_sigmas(fit: CircleFit, label: IntArray, slope_gain: FloatArray | float, radius: float) -> FloatArray:
    """Return standard deviations (N,) of the centres of a grid's circles, px.

    All are scaled by the ratio of the scatter of slants to that expected for white noise. The deviations of a single
    circle's size and slant, beyond this and beyond those common to all (motion stretches all circles), are an error of
    the map's first derivatives. At the rim, where it is not small, the map is extrapolated: if its polynomial lacks a
    term of order n in the distance t, the ratio of second to first derivatives is (n - 1) / t. A quarter of that, times
    the radius, shifts the centre: by the error of the size times the radius for n = 5, the first order that it lacks.
    Irregularities of an edge (dirt, a finger, print) shift it as much.

    Light that is added to the image (glare) gives the contrast another gradient than the brightness. The centre's move
    if both are fitted is an error as far as it exceeds noise. The centre stays, as the move is too noisy without glare
    and too small with clipping.

    Parameters
    ----------
    slope_gain : (N,) of the maps used by the fit (`PlaneMap`); 0 for maps of a camera.
    radius : in distances of neighbours.
    """
    size_px = np.sqrt(np.abs(np.linalg.det(fit.maps)))
    relative = fit.sigma_px / size_px
    typical = fit.growth_variance + (MODEL_SIGMA_PX / size_px)[:, None] ** 2
    typical = typical + 0.5 * (slope_gain * radius * relative)[:, None] ** 2
    odd = _without_smooth_part(fit.growth, label) ** 2
    more = _variance_over_white((odd / typical)[:, 1:])
    misshapen = np.maximum(odd.sum(axis=1) - ODD_BY_NOISE * more * typical.sum(axis=1), 0.0)
    wavy = (_without_smooth_part(fit.harmonics[:, :4].reshape(len(label), -1), label) ** 2).mean(axis=1)
    uneven = np.maximum(wavy - WAVY_BY_NOISE * more * relative**2, 0.0)
    moved = np.maximum((fit.added_light**2).sum(axis=1), 1e-12)
    by_noise = MOVED_BY_NOISE * more * np.trace(fit.added_light_covariance, axis1=1, axis2=2)
    # The sum of both coordinates, beyond noise, without a jump at its limit.
    glare = 0.5 * ERROR_PER_MOVE**2 * np.maximum(moved - by_noise**2 / moved, 0.0)
    return np.asarray(np.sqrt(more * fit.sigma_px**2 + (radius**2 * misshapen + uneven) * size_px**2 + glare))


def _variance_over_white(slants: FloatArray) -> float:
    """Return the ratio of the variance of the centres to that for white noise, from the squares (N, 2) of slants over
    their variances for white noise; as close to 1 as chance allows."""
    free = len(slants) - SMOOTH_TERMS if len(slants) >= MIN_SMOOTH else len(slants) - 1
    # The mean of two squares of normal deviates has the median ln 2; that of N scatters by 1 / (ln 2 sqrt(N)) of it.
    times = float(np.median(slants.mean(axis=1))) / log(2.0) * len(slants) / free
    chance = times**2 / (free * log(2.0) ** 2)
    sure = 1.0 - chance / max((times - 1.0) ** 2, 1e-12)
    return 1.0 + max(sure, 0.0) * (times - 1.0)


def _without_smooth_part(values: FloatArray, label: IntArray) -> FloatArray:
    """Return the residuals of `values` (N, K) from a quadratic surface over the places, or from their medians for few
    circles: common changes, and smooth ones due to lens and blur, are no scatter."""
    off = values - np.median(values, axis=0)
    if len(values) < MIN_SMOOTH:
        return off
    x, y = ((label - label.mean(axis=0)) / np.maximum(np.ptp(label, axis=0), 1)).T
    terms = np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], axis=1)
    return np.asarray(off - terms @ np.linalg.lstsq(terms, off, rcond=None)[0])
