"""What `detection.subpixel.correlation` asks the kernel of correlation.c for, in numpy; arguments as of
`rigkit.kernels.edges.sigma_factors` and `uneven_factors`."""

from __future__ import annotations

import numpy as np

from rigkit.core.arrays import FloatArray
from rigkit.detection.subpixel.correlation import (
    COVERED_TIMES,
    LIGHT_SHARE,
    LOST_ERROR,
    MIN_ALIKE,
    MIN_LEFT,
    MIN_SIGMA_FACTOR,
    UNEVEN_TIMES,
)
from rigkit.detection.subpixel.edge_fit import BLUR_RANGE
from rigkit.kernels.edges import LAGS, FactorRules, NoiseOfCorners

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


def sigma_factors(corners: NoiseOfCorners, boards: int, rules: FactorRules) -> FloatArray:
    products, pairs, noise, pixels, sides, blur, used, good, owner = corners
    assert (rules.light_share, rules.lost_error, rules.min_left) == (LIGHT_SHARE, LOST_ERROR, MIN_LEFT)
    assert (rules.covered_times, rules.min_factor, rules.min_blur) == (
        COVERED_TIMES,
        MIN_SIGMA_FACTOR,
        BLUR_RANGE[0],
    )
    seen = np.flatnonzero(good & (pairs[:, 0] > 0.0))
    if not len(seen):
        return np.ones(boards)
    member, level = owner[seen] == np.arange(boards)[:, None], noise[seen]
    # A hand or a ruler in the window is no noise, but as much the same from pixel to pixel as anything can be.
    typical = np.exp((member @ np.log(level)) / np.maximum(member.sum(axis=1), 1))
    member &= level <= COVERED_TIMES * typical[:, None]
    count = np.maximum(member.sum(axis=1), 1)[:, None]
    twice = 2.0 * pixels
    part = twice - np.floor(twice)
    blend = part * (1.0 - part)
    both = blend[:, :1] * blend[:, 1:]
    # Every corner says as much as its pixels do.
    alike = products / (noise**2)[:, None]
    known = (alike, pairs, sides.reshape(-1, 4), blur[:, None], used[:, None], blend, both)
    mean: FloatArray = (member / count) @ np.concatenate(known, axis=1)[seen]
    return np.where(member.any(axis=1), factors(mean, count, rules.radius_px), 1.0)


def uneven_factors(corners: NoiseOfCorners, typical: FloatArray, rules: FactorRules) -> FloatArray:
    products, pairs, noise, _, _, _, _, good, owner = corners
    assert (rules.min_alike, rules.uneven_times) == (MIN_ALIKE, UNEVEN_TIMES)
    out = np.ones(len(owner))
    seen = good & (pairs[:, 0] > 0.0)
    with np.errstate(invalid="ignore", divide="ignore"):
        alike = (products[:, 1:] / np.maximum(pairs[:, 1:], 1.0)).mean(axis=1) / noise**2
        odd = np.flatnonzero(seen & (alike > MIN_ALIKE * typical[owner] ** 2))
    if len(odd):
        alone = NoiseOfCorners._make(part[odd] for part in corners)
        own = sigma_factors(alone._replace(owner=np.arange(len(odd))), len(odd), rules)
        times = own / typical[owner[odd]]
        out[odd] = np.where(times > UNEVEN_TIMES, times, 1.0)
    return out


def factors(mean: FloatArray, count: FloatArray, radius_px: float) -> FloatArray:
    """Return the factors (P,) told by the `mean` (P, 35) of what is known of `count` (P, 1) corners."""
    pairs, shape = np.maximum(mean[:, len(LAGS) : 2 * len(LAGS)], 1.0), mean[:, 2 * len(LAGS) :]
    change = mean[:, : len(LAGS)] / pairs
    weight, lost = influence(shape[:, :4].reshape(-1, 2, 2), np.maximum(shape[:, 4], BLUR_RANGE[0]), radius_px)
    blended = _WHOLE + (shape[:, 6:] @ _BETWEEN).reshape(-1, len(LAGS), len(LAGS))
    weight = np.asarray(np.linalg.solve(np.swapaxes(blended, 1, 2), (_TIMES * weight)[..., None])[..., 0], np.float64)
    share = lost / np.maximum(shape[:, 5], 1.0)
    left = np.maximum(1.0 - share, MIN_LEFT)
    excess = (weight * change).sum(axis=1) / left - 1.0
    # Products of independent noise have this variance at all lags but none.
    chance = (weight[:, 1:] ** 2 / (count * pairs)[:, 1:]).sum(axis=1) * (change[:, 0] / left) ** 2
    # What is not known of `left` goes with the quotient: small windows, of which the fit takes most, say nothing.
    doubt = chance + ((1.0 + excess) * LOST_ERROR * share / left) ** 2
    sure = np.maximum(1.0 - doubt / np.maximum(excess**2, 1e-12), 0.0)
    return np.asarray(np.sqrt(np.maximum(1.0 + sure * excess, MIN_SIGMA_FACTOR**2)))


def influence(sides: FloatArray, blur: FloatArray, radius_px: float) -> tuple[FloatArray, FloatArray]:
    """Return w at LAGS (P, 13), the mean of both lines, and what the fit takes out of the noise (P,).

    For corners of cells with the `sides` (P, 2, 2) and of s `blur` (P,). The second is in pixels: over those of the
    window it is the share that the sum over lags lacks in what the model leaves. What mirroring changes holds the odd
    ones of the parameters twice: the corner, whose products are again correlated as its influence, and the gradient of
    the light, wide as the window.
    """
    lengths = np.maximum(np.hypot(sides[..., :1], sides[..., 1:]), 1.0)
    turned = sides / lengths @ _ALONG_AND_ASIDE
    along, lateral = turned[..., : len(LAGS)], turned[..., len(LAGS) :]
    reach = np.minimum(lengths, 2.0 * radius_px)
    # Over so much of the line it overlaps with itself, shifted: less over what has the other sign.
    overlap = np.maximum(1.0 - 3.0 * np.abs(along) / reach, 0.0)
    across = np.exp(lateral**2 / (-4.0 * blur**2)[:, None, None])
    weight: FloatArray = ((across * overlap).sum(axis=1) * 0.5 - LIGHT_SHARE) / (1.0 - LIGHT_SHARE)
    light = np.maximum(1.0 - _LENGTH / reach[:, 0], 0.0)
    lost: FloatArray = 4.0 * (_TIMES * weight * (weight + light)).sum(axis=1)
    return weight, lost
