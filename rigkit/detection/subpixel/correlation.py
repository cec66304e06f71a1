"""Factors of the corners' standard deviations due to correlated noise of neighbouring pixels.

Demosaicing, smoothing and enlarging cause positively correlated noise; JPEG and sharpening cause noise of alternating
sign. A corner's position is a sum of pixels weighted by their influence. Its variance is therefore

    sum over lags of  w(lag) r(lag)

times that under independent noise of equal variance, with r the correlation of the noise of two pixels `lag` apart and
w that of their influences, w(0) = r(0) = 1. The influence is concentrated on the two lines through the corner: across a
line it is a Gaussian of standard deviation s, along it its sign changes at the corner. The antisymmetric part of the
residuals (`edge_fit`) is noise only, and determines r for all corners of a board together.
"""

from __future__ import annotations

import functools

import numpy as np

from rigkit.core.arrays import BoolArray, FloatArray, IntArray
from rigkit.detection.subpixel.edge_fit import BLUR_RANGE, EdgeFit
from rigkit.kernels import edges

LIGHT_SHARE = 0.16
"""Share of a shift of the corner that the fitted gradient of the light absorbs: 0.13 to 0.18 for edges with s from 0.4
to 2 px and squares of 25 and 50 px."""

LOST_ERROR = 0.3
"""Relative uncertainty of the share of the noise that the fit absorbs, for squares of 8 to 50 px, sharp and blurred."""

MIN_LEFT = 0.05
"""Smallest share of the noise in the residuals of the fit that is used."""

COVERED_TIMES = 2.0
"""Corners with more than this times the board's noise are not used for the correlation."""

MIN_ALIKE, UNEVEN_TIMES = 0.1, 1.5
"""A corner's window shows more than noise if neighbouring pixels are correlated by more than MIN_ALIKE times the square
of the board's factor, and its own factor exceeds UNEVEN_TIMES the board's. Of 6480 corners of boards with noise only
(RENDERED) two exceed both; at edges of shadows, fingers and glare the ratio is 1.6 to 4."""

MIN_SIGMA_FACTOR = 0.5
"""Lower bound of the factor of sigma."""


def board_factors(
    fit: EdgeFit, good: BoolArray, sides: FloatArray, owner: IntArray, boards: int, radius_px: float
) -> tuple[FloatArray, FloatArray]:
    """Return the factor (P,) of the sigmas of each of P `boards`, 1 without significant correlation, and those (N,) of
    corners with more noise than their board (`edges.uneven_factors`).

    Parameters
    ----------
    fit : of N corners, with noise separated from other residuals.
    good : (N,) corners to be used.
    sides : (N, 2, 2) sides of the cells, px.
    owner : (N,) index of the board of each corner.
    radius_px : of the windows of the fit.
    """
    noise, rules = _noise_of(fit, good, sides, owner), factor_rules(radius_px)
    factors = edges.sigma_factors(noise, boards, rules)
    return factors, edges.uneven_factors(noise, factors, rules)


def _noise_of(fit: EdgeFit, good: BoolArray, sides: FloatArray, owner: IntArray) -> edges.NoiseOfCorners:
    # Contiguous copies, once for both kernels.
    alone = np.ascontiguousarray
    return edges.NoiseOfCorners(
        *(alone(fit.products), alone(fit.pairs), alone(fit.noise), alone(fit.pixels), alone(sides)),
        *(alone(fit.blur), alone(fit.used), good, owner),
    )


def with_uneven(fit: EdgeFit, sides: FloatArray, radius_px: float, *, marked: bool) -> tuple[EdgeFit, float]:
    """Return the `fit` of a board's N corners, whose cells have `sides` (N, 2, 2), with sigmas multiplied by
    `edges.uneven_factors`, and the board's `edges.sigma_factors`, by which they are not.

    That of a `marked` board, with markers in its squares, is at least 1: all its residuals count as noise, and those
    due to markers may have any sign.
    """
    noise = _noise_of(fit, fit.valid & (fit.contrast > 0.0), sides, np.zeros(len(sides), np.int64))
    rules = factor_rules(radius_px)
    typical = np.maximum(edges.sigma_factors(noise, 1, rules), 1.0 if marked else 0.0)
    return fit.with_sigma_factors(edges.uneven_factors(noise, typical, rules)), float(typical[0])


@functools.cache
def factor_rules(radius_px: float) -> edges.FactorRules:
    return edges.FactorRules.of(
        light_share=LIGHT_SHARE,
        lost_error=LOST_ERROR,
        min_left=MIN_LEFT,
        covered_times=COVERED_TIMES,
        min_factor=MIN_SIGMA_FACTOR,
        min_alike=MIN_ALIKE,
        uneven_times=UNEVEN_TIMES,
        min_blur=BLUR_RANGE[0],
        radius_px=radius_px,
    )
