"""Chessboard corners by maximum likelihood: Gauss-Newton on the edge model, all corners of an image at once.

For noise that is independent and equal in all pixels, least squares is maximum likelihood and reaches the Cramer-Rao
bound; the same normal equations predict the standard deviation. How large the noise is, is read from what the model
leaves and mirroring at the corner changes: blur of another shape, a tone curve or sharpening leave much, but the same
on both sides, and so do not move the corner.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass

import numpy as np

from rigkit.core.arrays import BoolArray, FloatArray
from rigkit.detection.saddles.response import GreyImage
from rigkit.detection.subpixel.edge_model import (
    END_SIGMAS,
    GX,
    GY,
    K1,
    K2,
    MIN_REACH,
    NEAR_PX,
    NEAR_SIGMAS,
    PARAMETERS,
    PIXEL_KURTOSIS,
    SHARP_BLUR_PX,
    T1,
    T2,
    TAIL_SIGMAS,
    WINDOW_REACH,
    A,
    B,
    Geometry,
    S,
    Window,
    X,
    Y,
    collect,
    linearise,
    pattern_of,
)
from rigkit.kernels.edges import LAGS, Rules, fit_corners

__all__ = ["BLUR_RANGE", "EdgeFit", "fit_edges"]

MIN_DETERMINED_PIXELS = K1
"""So many parameters only the pixels determine; the curvatures of the lines are mostly the lattice's."""

BLUR_RANGE = (0.28, 5.0)
"""s of a perfectly sharp image is the pixel's own 0.29; above 5 px there is no edge to speak of."""

ANGLE_SIGMA_RAD = 0.1
LOG_BLUR_SIGMA = 0.7
LIGHT_SIGMA_PER_PX = 0.01
"""How well the lattice's angles, the start's log s and an even light (g = 0) are known beforehand. These matter only
where squares are so small that the pixels cannot tell; there, a gradient of the light passes for a shifted corner."""

MAX_MOVE_PX, MAX_TURN_RAD, MAX_BLUR_CHANGE, MAX_LIGHT_CHANGE = 1.0, 0.2, 0.3, 0.3
"""A step is cut where it would leave the region in which the model is nearly linear: position, angles, relative blur,
light."""

BLUR_LAG = 2.0
"""The last step may change s by this part of it for each px that it may move the corner: a wrong s hardly moves the
corner, but adds to the residuals and so to the predicted sigma, most of all on sharp edges."""

MIN_MIRRORED, MAX_MIRRORED_PX = 12, 2.0
"""Noise is read from so many pixels with a mirror image at least, and not where a corner has ended so far from the
middle of its window: little of the window has a mirror image then."""

START_BLOCK = 64
"""Brightness and contrast to start from are those of every second block of so many pixels, the compiled fit's."""

ROUNDING_VARIANCE = 1.0 / 12.0
"""Of grey levels, the least in 8-bit images: in flat squares rounding is the same everywhere and leaves nothing, but at
the edges, where the corner comes from, its error varies evenly over a level."""

MIN_VARIANCE = 1e-6
FIT_RIDGE = 1e-9
"""Of grey levels, and on the normal equations' diagonal: keep an image without noise or without contrast solvable."""

VALID_MOVE_PX, VALID_MOVE_CELLS = 1.5, 0.2
"""A fit that ends further from its start, in px or in sides of its cell, has found something else."""


@dataclass(frozen=True, eq=False, slots=True)
class EdgeFit:
    """The fitted corners.

    Attributes
    ----------
    pixels : (N, 2)
    sigma_px : (N,) predicted standard deviation per axis, from the noise and the curvature of the likelihood.
    blur : (N,) s, px.
    contrast : (N,) 2 b, negative if bright and dark are the other way round than expected.
    residual : (N,) root mean square, grey levels.
    noise : (N,) the same of the part that mirroring changes, as that of independent noise.
    used : (N,) number of pixels.
    products, pairs : (N, 13) for each of `kernels.edges.LAGS` the sum of the products of what mirroring changes at two
        pixels so far apart, and of how many; 0 where the noise is not known or that of rounding.
    valid : (N,) the fit converged near its start, with pixels on all sides.
    """

    pixels: FloatArray
    sigma_px: FloatArray
    blur: FloatArray
    contrast: FloatArray
    residual: FloatArray
    noise: FloatArray
    used: FloatArray
    products: FloatArray
    pairs: FloatArray
    valid: BoolArray


def fit_edges(
    image: GreyImage,
    pixels: FloatArray,
    geometry: Geometry,
    sign: FloatArray,
    blur: FloatArray,
    *,
    radius_px: float,
    iterations: int,
    converged_px: float = 1e-3,
    mirrored: bool = True,
    curvature_sigma: FloatArray | None = None,
    contrast: FloatArray | None = None,
) -> EdgeFit:
    """Fit the edge model to `image` (as `grey_image` returns it) around the corners that are near `pixels` (N, 2).

    Parameters
    ----------
    sign : (N,) +1 where brightness grows with the angle across line 1.
    blur : (N,) expected s.
    radius_px : pixels further from the corner are not used.
    iterations : Gauss-Newton steps at most.
    mirrored : tell noise from other residuals; otherwise all counts as noise.
    converged_px : the last step moves the corner by less than this; the next one would by a hundredth of it.
    curvature_sigma : (N, 2) how well the geometry's curvatures are known, 1/px; where 0, and without, both are kept.
    contrast : (N,) expected contrast; where NaN, and without, it is read from the window.
    """
    expected = np.full(len(pixels), np.nan) if contrast is None else contrast
    loose = np.zeros((len(pixels), 2)) if curvature_sigma is None else curvature_sigma
    least = ROUNDING_VARIANCE if image.dtype == np.uint8 else MIN_VARIANCE
    fitted = fit_corners(
        image,
        pixels,
        geometry.sides,
        geometry.curvature,
        loose,
        geometry.gaps,
        geometry.ends,
        sign,
        blur,
        expected,
        _rules(radius_px, iterations, converged_px, mirrored, least),
    )
    if fitted is not None:
        _, _, sigma_px, width, contrast, residual, noise, valid, used = fitted[:, : -2 * len(LAGS)].T
        products, pairs = fitted[:, -2 * len(LAGS) : -len(LAGS)], fitted[:, -len(LAGS) :]
        return EdgeFit(fitted[:, :2], sigma_px, width, contrast, residual, noise, used, products, pairs, valid > 0.5)
    window = collect(image, pixels, geometry, blur, radius_px)
    prior_mean, prior = _prior(geometry, loose, blur, window.size)
    kept = np.count_nonzero(loose > 0.0, axis=1) < 2
    values = prior_mean.copy()
    values[:, [X, Y]] = pixels - window.centre
    _brightness(values, window, geometry, sign, expected)
    used = window.weight.sum(axis=1, dtype=np.float64)
    free = np.maximum(used - MIN_DETERMINED_PIXELS, 1.0)
    variance = np.full(len(pixels), np.inf)
    normal = np.zeros((len(pixels), PARAMETERS, PARAMETERS))
    rest = np.zeros(window.weight.shape)
    active = np.ones(len(pixels), bool)
    diagonal = range(PARAMETERS)
    for _ in range(iterations):
        every = bool(active.all())
        rows = linearise(
            values[active], window if every else window.of(active), geometry if every else geometry.of(active)
        )
        rows[kept[active], K1 : K2 + 1] = 0.0
        products = (rows @ np.swapaxes(rows, 1, 2)).astype(np.float64)
        variance[active] = np.maximum(products[:, -1, -1] / free[active], least)
        pull = prior[active] * variance[active, None]
        hessian = products[:, :-1, :-1]
        hessian[:, diagonal, diagonal] += pull + FIT_RIDGE
        gradient = products[:, :-1, -1] + pull * (prior_mean - values)[active]
        step = np.linalg.solve(hessian, gradient[..., None])[..., 0]
        normal[active] = hessian
        taken = _limited(step, values[active])
        values[active] += taken
        # What is left after a step is linear in it: the last one is small.
        rest[active] = rows[:, -1] - (taken[:, None].astype(np.float32) @ rows[:, :-1])[:, 0]
        change = np.abs(step[:, [X, Y, S]])
        change[:, 2] /= BLUR_LAG * values[active, S]
        active[np.flatnonzero(active)[change.max(axis=1) <= converged_px]] = False
        if not active.any():
            break
    noise, lags = variance, np.zeros((2, len(pixels), len(LAGS)))
    if mirrored:
        variance = np.maximum((rest**2).sum(axis=1) / free, least)
        noise, lags = _noise(values, variance, window, rest)
        lags[:, noise <= least] = 0.0
        noise = np.maximum(noise, least)
    return _result(values, variance, noise, lags, normal, window, pixels, geometry, sign)


@functools.cache
def _rules(radius_px: float, iterations: int, converged_px: float, mirrored: bool, least: float) -> Rules:
    return Rules(
        reach=WINDOW_REACH,
        end_sigmas=END_SIGMAS,
        least_reach=MIN_REACH,
        near_sigmas=NEAR_SIGMAS,
        near_px=NEAR_PX,
        tail_sigmas=TAIL_SIGMAS,
        pixel_kurtosis=PIXEL_KURTOSIS,
        sharp_blur=SHARP_BLUR_PX,
        least_blur=BLUR_RANGE[0],
        most_blur=BLUR_RANGE[1],
        angle_sigma=ANGLE_SIGMA_RAD,
        log_blur_sigma=LOG_BLUR_SIGMA,
        light_sigma=LIGHT_SIGMA_PER_PX,
        most_move_px=MAX_MOVE_PX,
        most_turn=MAX_TURN_RAD,
        most_blur_change=MAX_BLUR_CHANGE,
        most_light_change=MAX_LIGHT_CHANGE,
        least_variance=least,
        ridge=FIT_RIDGE,
        converged_px=converged_px,
        blur_lag=BLUR_LAG,
        valid_move_px=VALID_MOVE_PX,
        valid_move_cells=VALID_MOVE_CELLS,
        most_mirrored=MAX_MIRRORED_PX,
        radius_px=radius_px,
        iterations=iterations,
        mirrored=mirrored,
        fewest_mirrored=MIN_MIRRORED,
    )


def _prior(geometry: Geometry, loose: FloatArray, blur: FloatArray, size: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the parameters as known beforehand (N, 11) and one over their variances, 0 for unknown."""
    mean = np.zeros((len(blur), PARAMETERS))
    mean[:, [T1, T2]] = np.arctan2(geometry.sides[..., 1], geometry.sides[..., 0])
    mean[:, S] = blur
    mean[:, [K1, K2]] = geometry.curvature
    weight = np.zeros_like(mean)
    weight[:, [T1, T2]] = ANGLE_SIGMA_RAD**-2
    weight[:, S] = (LOG_BLUR_SIGMA * blur) ** -2
    weight[:, [K1, K2]] = np.where(loose > 0.0, loose, 1.0) ** -2.0
    weight[:, [GX, GY]] = ((LIGHT_SIGMA_PER_PX * size) ** -2)[:, None]
    return mean, weight


def _brightness(values: FloatArray, window: Window, geometry: Geometry, sign: FloatArray, contrast: FloatArray) -> None:
    """Set a and b of `values` by linear least squares with everything else as it stands, from half of the pixels.

    Where the contrast is known, b is half of it and a the mean: the first step finds a, in which the model is linear.
    """
    every = np.arange(window.weight.shape[1]) // START_BLOCK % 2 == 0
    weight = window.weight * every
    pattern = pattern_of(values, window, geometry) * sign[:, None].astype(np.float32)
    total = np.maximum(weight.sum(axis=1, dtype=np.float64), 1.0)
    mean_p = (weight * pattern).sum(axis=1, dtype=np.float64) / total
    mean_i = (weight * window.value).sum(axis=1, dtype=np.float64) / total
    spread = (pattern - mean_p[:, None].astype(np.float32)) * weight
    slope = (spread * window.value).sum(axis=1) / np.maximum((spread**2).sum(axis=1), 1e-9)
    known = np.isfinite(contrast)
    count = np.maximum(window.weight.sum(axis=1, dtype=np.float64), 1.0)
    mean = (window.weight * window.value).sum(axis=1, dtype=np.float64) / count
    values[:, B] = np.where(known, 0.5 * contrast, slope) * sign
    values[:, A] = np.where(known, mean, mean_i - slope * mean_p)


def _limited(step: FloatArray, values: FloatArray) -> FloatArray:
    """Return the step, cut where it would leave the region in which the model is nearly linear."""
    limit = np.full(step.shape, np.inf)
    limit[:, [X, Y]] = MAX_MOVE_PX
    limit[:, [T1, T2]] = MAX_TURN_RAD
    limit[:, S] = MAX_BLUR_CHANGE * values[:, S]
    limit[:, [GX, GY]] = MAX_LIGHT_CHANGE
    out = np.clip(step, -limit, limit)
    out[:, S] = np.clip(values[:, S] + out[:, S], *BLUR_RANGE) - values[:, S]
    return out


def _noise(values: FloatArray, variance: FloatArray, window: Window, rest: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the variance (N,) of the noise: of the `rest` (N, P) of the model, less what mirroring leaves, too.

    Mirrored at the corner, a pixel falls between four, which are interpolated; where one of them is not in the window
    it has no mirror image. Few such pixels: `variance`, that of all residuals. The second result are `products` and
    `pairs` of `EdgeFit`, (2, N, 13).
    """
    used = window.weight > 0.0
    middle = int(max(np.abs(window.u).max(initial=0.0), np.abs(window.v).max(initial=0.0))) + 1
    across = 2 * middle + 1
    u, v = window.u.astype(np.int64), window.v.astype(np.int64)
    owner = np.broadcast_to(np.arange(len(rest))[:, None], rest.shape)
    # Two more rows and columns of nothing, for mirror images that fall outside.
    square = np.full((len(rest), across + 2, across + 2), np.nan)
    square[owner[used], v[used] + middle, u[used] + middle] = rest[used]
    twice = 2.0 * values[:, [X, Y]]
    whole = np.floor(twice)
    right, below = (twice - whole).T[:, :, None]
    from_u, from_v = (whole.astype(np.int64) + middle).T[:, :, None]
    row, column = from_v - v, from_u - u
    outside = (row < 0) | (column < 0) | (row >= across) | (column >= across)
    row, column = np.where(outside, across, row), np.where(outside, across, column)
    places = (
        ((1.0 - right) * (1.0 - below), 0, 0),
        (right * (1.0 - below), 0, 1),
        ((1.0 - right) * below, 1, 0),
        (right * below, 1, 1),
    )
    mirror = sum(weight * square[owner, row + down, column + over] for weight, down, over in places)
    spread = 1.0 + sum(weight[:, 0] ** 2 for weight, _, _ in places)
    change = np.where(used, rest - mirror, np.nan)
    paired = np.isfinite(change)
    pairs, count = paired.sum(axis=1), used.sum(axis=1)
    mean = np.where(paired, change, 0.0) ** 2
    apart = mean.sum(axis=1) / np.maximum(pairs, 1) / spread * count / np.maximum(count - MIN_DETERMINED_PIXELS, 1)
    enough = (pairs >= MIN_MIRRORED) & (count > MIN_DETERMINED_PIXELS)
    enough &= np.abs(values[:, [X, Y]]).max(axis=1) <= MAX_MIRRORED_PX
    lags = _lag_products(np.where(paired, change, 0.0), paired, window, np.floor(values[:, Y]))
    return np.where(enough, apart, variance), np.where(enough[:, None], lags, 0.0)


def _lag_products(change: FloatArray, paired: BoolArray, window: Window, last: FloatArray) -> FloatArray:
    """Return `products` and `pairs` of `EdgeFit` (2, N, 13) from what mirroring changes at the `paired` pixels (N, P).

    Rows after `last` (N,) are left out: they are mirror images of the others.
    """
    paired = paired & (window.v <= last[:, None])
    middle = int(max(np.abs(window.u).max(initial=0.0), np.abs(window.v).max(initial=0.0))) + 1
    across = 2 * middle + 1
    u, v = (part.astype(np.int64)[paired] + middle for part in (window.u, window.v))
    owner = np.nonzero(paired)[0]
    # A margin of nothing, for pixels beyond the window.
    square = np.zeros((2, len(change), across + 4, across + 4))
    square[0, owner, v + 2, u + 2], square[1, owner, v + 2, u + 2] = change[paired], 1.0
    here = square[:, :, 2:-2, 2:-2]
    out = [
        (here * square[:, :, 2 + down : across + 2 + down, 2 + right : across + 2 + right]).sum(axis=(2, 3))
        for down, right in LAGS
    ]
    return np.stack(out, axis=-1)


def _surrounded(pixels: FloatArray, window: Window) -> BoolArray:
    """Return whether there are pixels on all sides of the corner: it is not cut off by the frame."""
    off = (window.centre - pixels).astype(np.float32)
    u, v = (window.u + off[:, :1]) * window.weight, (window.v + off[:, 1:]) * window.weight
    surrounded: BoolArray = np.all([(part > 0.5).sum(axis=1) >= 2 for part in (u, -u, v, -v)], axis=0)
    return surrounded


def _result(
    values: FloatArray,
    variance: FloatArray,
    noise: FloatArray,
    lags: FloatArray,
    normal: FloatArray,
    window: Window,
    start: FloatArray,
    geometry: Geometry,
    sign: FloatArray,
) -> EdgeFit:
    covariance = np.linalg.inv(normal) * noise[:, None, None]
    pixels = window.centre + values[:, [X, Y]]
    spread = 0.5 * (covariance[:, X, X] + covariance[:, Y, Y])
    moved = np.linalg.norm(pixels - start, axis=1)
    longest = np.linalg.norm(geometry.sides, axis=2).max(axis=1)
    valid = (moved < np.maximum(VALID_MOVE_PX, VALID_MOVE_CELLS * longest)) & (spread > 0.0) & np.isfinite(spread)
    valid &= (window.weight.sum(axis=1) > MIN_DETERMINED_PIXELS) & _surrounded(pixels, window)
    return EdgeFit(
        pixels,
        np.sqrt(np.where(valid, spread, 0.0)),
        values[:, S],
        2.0 * values[:, B] * sign,
        np.sqrt(variance),
        np.sqrt(noise),
        window.weight.sum(axis=1, dtype=np.float64),
        lags[0],
        lags[1],
        valid,
    )
