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

from dataclasses import replace

import numpy as np

from rigkit.core.arrays import BoolArray, FloatArray, IntArray
from rigkit.detection.subpixel.edge_fit import BLUR_RANGE, EdgeFit
from rigkit.kernels.edges import LAGS

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

_ROW, _COLUMN = np.array(LAGS, dtype=np.float64).T
_LENGTH = np.hypot(_ROW, _COLUMN)
_TIMES = np.where(_LENGTH > 0.0, 2.0, 1.0)
"""The opposite lags count, too."""
_ALONG_AND_ASIDE = np.concatenate([[_COLUMN, _ROW], [_ROW, -_COLUMN]], axis=1)
"""A direction times this is how far the lags go along it and aside."""


def _blends() -> tuple[FloatArray, FloatArray]:
    """Return what turns products of noise at LAGS into those of changes, (13, 13), and how that grows (3, 169).

    A mirror image falls between four pixels, parts f and 1 - f of the way along u and v, and blends them: two mirror
    images share noise if they blend neighbours. It grows with f (1 - f) of u, of v, and with the product of both.
    """
    place = {lag: k for k, lag in enumerate(LAGS)} | {(-row, -column): k for k, (row, column) in enumerate(LAGS)}
    same, right, below, aslant = near = np.zeros((4, len(LAGS), len(LAGS)))
    for k, (row, column) in enumerate(LAGS):
        for down, over in ((a, b) for a in (-1, 0, 1) for b in (-1, 0, 1)):
            beside = place.get((row + down, column + over))
            if beside is not None:
                near[2 * abs(down) + abs(over), k, beside] += 1.0
    grown = np.stack([right - 2.0 * same, below - 2.0 * same, 4.0 * same - 2.0 * (right + below) + aslant])
    return np.eye(len(LAGS)) + same, grown.reshape(3, -1)


_WHOLE, _BETWEEN = _blends()


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
    seen = np.flatnonzero(good & (fit.pairs[:, 0] > 0.0))
    if not len(seen):
        return np.ones(boards)
    member, noise = owner[seen] == np.arange(boards)[:, None], fit.noise[seen]
    # A hand or a ruler in the window is no noise, but as much the same from pixel to pixel as anything can be.
    usual = np.exp((member @ np.log(noise)) / np.maximum(member.sum(axis=1), 1))
    member &= noise <= COVERED_TIMES * usual[:, None]
    count = np.maximum(member.sum(axis=1), 1)[:, None]
    mean = (member / count) @ _known(fit, sides)[seen]
    return np.where(member.any(axis=1), _factors(mean, count, radius_px), 1.0)


def uneven_factors(
    fit: EdgeFit, good: BoolArray, sides: FloatArray, owner: IntArray, usual: FloatArray, radius_px: float
) -> FloatArray:
    """Return the factor (N,) for the sigmas of corners beside those of their boards, `usual` (P,): 1 but for corners
    beside which there is more than noise.

    The edge of a shadow, glare or a finger in the window leaves what is the same over many pixels, and what of it looks
    like a shift of the corner is in none of the residuals. Arguments else as of `sigma_factors`.
    """
    factors = np.ones(len(owner))
    seen = good & (fit.pairs[:, 0] > 0.0)
    with np.errstate(invalid="ignore", divide="ignore"):
        alike = (fit.products[:, 1:] / np.maximum(fit.pairs[:, 1:], 1.0)).mean(axis=1) / fit.noise**2
        odd = seen & (alike > MIN_ALIKE * usual[owner] ** 2)
    if odd.any():
        own = _factors(_known(fit.of(odd), sides[odd]), np.ones((np.count_nonzero(odd), 1)), radius_px)
        times = own / usual[owner[odd]]
        factors[odd] = np.where(times > UNEVEN_TIMES, times, 1.0)
    return factors


def with_uneven(fit: EdgeFit, sides: FloatArray, radius_px: float, *, marked: bool) -> EdgeFit:
    """Return the `fit` of a board's N corners, whose cells have `sides` (N, 2, 2), with `uneven_factors`.

    On a board that is `marked` between its corners all that is left counts as noise, and no factor of the board's does.
    """
    good, owner = fit.valid & (fit.contrast > 0.0), np.zeros(len(sides), np.int64)
    usual = np.ones(1) if marked else sigma_factors(fit, good, sides, owner, 1, radius_px)
    return replace(fit, sigma_px=fit.sigma_px * uneven_factors(fit, good, sides, owner, usual, radius_px))


def _known(fit: EdgeFit, sides: FloatArray) -> FloatArray:
    """Return what `_factors` is told of each of N corners, whatever the noise there, (N, 34)."""
    twice = 2.0 * fit.pixels
    part = twice - np.floor(twice)
    blend = part * (1.0 - part)
    both = blend[:, :1] * blend[:, 1:]
    # Every corner says as much as its pixels do.
    products = fit.products / (fit.noise**2)[:, None]
    known = (products, fit.pairs, sides.reshape(-1, 4), fit.blur[:, None], fit.used[:, None], blend, both)
    return np.concatenate(known, axis=1)


def _factors(mean: FloatArray, count: FloatArray, radius_px: float) -> FloatArray:
    """Return the factors (P,) told by the `mean` (P, 34) of what `_known` says of `count` (P, 1) corners."""
    pairs, shape = np.maximum(mean[:, len(LAGS) : 2 * len(LAGS)], 1.0), mean[:, 2 * len(LAGS) :]
    change = mean[:, : len(LAGS)] / pairs
    influence, lost = _influence(shape[:, :4].reshape(-1, 2, 2), np.maximum(shape[:, 4], BLUR_RANGE[0]), radius_px)
    blended = _WHOLE + (shape[:, 6:] @ _BETWEEN).reshape(-1, len(LAGS), len(LAGS))
    weight = np.linalg.solve(np.swapaxes(blended, 1, 2), (_TIMES * influence)[..., None])[..., 0]
    share = lost / np.maximum(shape[:, 5], 1.0)
    left = np.maximum(1.0 - share, MIN_LEFT)
    excess = (weight * change).sum(axis=1) / left - 1.0
    # Products of independent noise have this variance at all lags but none.
    chance = (weight[:, 1:] ** 2 / (count * pairs)[:, 1:]).sum(axis=1) * (change[:, 0] / left) ** 2
    # What is not known of `left` goes with the quotient: small windows, of which the fit takes most, say nothing.
    doubt = chance + ((1.0 + excess) * LOST_ERROR * share / left) ** 2
    sure = np.maximum(1.0 - doubt / np.maximum(excess**2, 1e-12), 0.0)
    factors: FloatArray = np.sqrt(np.maximum(1.0 + sure * excess, MIN_SIGMA_FACTOR**2))
    return factors


def _influence(sides: FloatArray, blur: FloatArray, radius_px: float) -> tuple[FloatArray, FloatArray]:
    """Return w at LAGS (P, 13), the mean of both lines, and what the fit takes out of the noise (P,).

    For corners of cells with the `sides` (P, 2, 2) and of s `blur` (P,). The second is in pixels: over those of the
    window it is the share that the sum over lags lacks in what the model leaves. What mirroring changes holds the odd
    ones of the parameters twice: the corner, whose products are again correlated as its influence, and the gradient of
    the light, wide as the window.
    """
    lengths = np.maximum(np.hypot(sides[..., :1], sides[..., 1:]), 1.0)
    turned = sides / lengths @ _ALONG_AND_ASIDE
    along, aside = turned[..., : len(LAGS)], turned[..., len(LAGS) :]
    reach = np.minimum(lengths, 2.0 * radius_px)
    # Over so much of the line it overlaps with itself, shifted: less over what has the other sign.
    overlap = np.maximum(1.0 - 3.0 * np.abs(along) / reach, 0.0)
    across = np.exp(aside**2 / (-4.0 * blur**2)[:, None, None])
    influence: FloatArray = ((across * overlap).sum(axis=1) * 0.5 - LIGHT_SHARE) / (1.0 - LIGHT_SHARE)
    light = np.maximum(1.0 - _LENGTH / reach[:, 0], 0.0)
    lost: FloatArray = 4.0 * (_TIMES * influence * (influence + light)).sum(axis=1)
    return influence, lost
