"""How much less, or more, certain corners are than if the noise of neighbouring pixels were independent.

Demosaiced, smoothed or enlarged images have noise that neighbours share; that of JPEG and of sharpening changes its
sign from pixel to pixel. A corner is placed by a sum of the pixels weighted by their influence, so has the variance

    sum over lags of  w(lag) r(lag)

times that under as much independent noise, r being the correlation of the noise of two pixels `lag` apart and w that of
their influences, w(0) = r(0) = 1. Influence lies on the two lines through the corner: across a line it is a Gaussian of
standard deviation s, along it of one sign on this side of the corner and of the other beyond it. What mirroring at the
corner changes (`edge_fit`) is noise alone, and says r, for all corners of a board together.
"""

from __future__ import annotations

import functools

import numpy as np

from rigkit.core.arrays import BoolArray, FloatArray, IntArray
from rigkit.detection.subpixel.edge_fit import BLUR_RANGE, EdgeFit
from rigkit.kernels import edges

LIGHT_SHARE = 0.16
"""So much of a shift of the corner looks like a gradient of the light, which is fitted, too: 0.13 to 0.18 for edges of
s from 0.4 to 2 px and squares of 25 and 50 px."""

LOST_ERROR = 0.3
"""How well it is known what the fit takes out of the noise, relative: squares of 8 to 50 px, sharp and blurred."""

MIN_LEFT = 0.05
"""A smaller share of the noise than this, left by the fit, would say nothing."""

COVERED_TIMES = 2.0
"""Where there is so many times the noise that is usual on the board, it is not the camera's alone."""

MIN_ALIKE, UNEVEN_TIMES = 0.1, 1.5
"""A corner has more than noise beside it where neighbouring pixels share so much, in parts of the noise and times the
square of the board's factor, and its own factor is the second number times the board's. Of 6480 corners of rendered
boards under noise alone two have both (RENDERED); at edges of shadows, fingers and glare it is 1.6 to 4."""

MIN_SIGMA_FACTOR = 0.5
"""Of sigma: noise that cancels over a few pixels never does so altogether."""


def sigma_factors(
    fit: EdgeFit, good: BoolArray, sides: FloatArray, owner: IntArray, boards: int, radius_px: float
) -> FloatArray:
    """Return the factor (P,) for the sigmas of each of P `boards`: 1 where no correlation is seen beyond doubt.

    Parameters
    ----------
    fit : of N corners, with noise told from other residuals.
    good : (N,) corners to rely on.
    sides : (N, 2, 2) the cells' sides, px.
    owner : (N,) the board of each corner.
    radius_px : of the fit.
    """
    return edges.sigma_factors(_noise_of(fit, good, sides, owner), boards, factor_rules(radius_px))


def uneven_factors(
    fit: EdgeFit, good: BoolArray, sides: FloatArray, owner: IntArray, typical: FloatArray, radius_px: float
) -> FloatArray:
    """Return the factor (N,) for the sigmas of corners beside those of their boards, `typical` (P,): 1 but for corners
    beside which there is more than noise.

    The edge of a shadow, glare or a finger in the window leaves what is the same over many pixels, and what of it looks
    like a shift of the corner is in none of the residuals. Arguments else as of `sigma_factors`.
    """
    return edges.uneven_factors(_noise_of(fit, good, sides, owner), typical, factor_rules(radius_px))


def board_factors(
    fit: EdgeFit, good: BoolArray, sides: FloatArray, owner: IntArray, boards: int, radius_px: float
) -> tuple[FloatArray, FloatArray]:
    """Return `sigma_factors` (P,), and beside these `uneven_factors` (N,)."""
    noise, rules = _noise_of(fit, good, sides, owner), factor_rules(radius_px)
    factors = edges.sigma_factors(noise, boards, rules)
    return factors, edges.uneven_factors(noise, factors, rules)


def _noise_of(fit: EdgeFit, good: BoolArray, sides: FloatArray, owner: IntArray) -> edges.NoiseOfCorners:
    # Copied here, once for both kernels, which take arrays that lie by themselves in memory.
    alone = np.ascontiguousarray
    return edges.NoiseOfCorners(
        *(alone(fit.products), alone(fit.pairs), alone(fit.noise), alone(fit.pixels), alone(sides)),
        *(alone(fit.blur), alone(fit.used), good, owner),
    )


def shared_noise(fit: EdgeFit, sides: FloatArray, radius_px: float, *, marked: bool) -> float:
    """Return the `sigma_factors` of one board, of the `fit` of its N corners, whose cells have `sides` (N, 2, 2).

    On a board that is `marked` between its corners all that is left counts as noise, and no factor of the board's does.
    """
    good, owner = fit.valid & (fit.contrast > 0.0), np.zeros(len(sides), np.int64)
    return 1.0 if marked else float(sigma_factors(fit, good, sides, owner, 1, radius_px)[0])


def with_uneven(fit: EdgeFit, sides: FloatArray, radius_px: float, typical: float) -> EdgeFit:
    """Return the `fit` of a board's N corners, whose cells have `sides` (N, 2, 2), with `uneven_factors` beside the
    board's `typical` one."""
    good, owner = fit.valid & (fit.contrast > 0.0), np.zeros(len(sides), np.int64)
    return fit.less_sure(uneven_factors(fit, good, sides, owner, np.array([typical]), radius_px))


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
