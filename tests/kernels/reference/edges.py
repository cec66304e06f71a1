"""What the detector asks the kernels of edges.c for, in numpy; arguments as those of `rigkit.kernels.edges`.

The constants of the model are those of the detector, whatever the rules say. Arrays of pixels are float32: N corners x
P pixels x 11 derivatives, of values 0..255, summed in products of P terms; the corner is good to 1e-5 px.
"""

from __future__ import annotations

import numpy as np
from kernels.reference.edge_model import (
    GX,
    GY,
    K1,
    K2,
    PARAMETERS,
    T1,
    T2,
    A,
    B,
    S,
    Window,
    X,
    Y,
    collect,
    linearise,
    pattern_of,
)

from rigkit.core.arrays import BoolArray, FloatArray
from rigkit.detection.guided.corner_fit import MARKER_BLURS
from rigkit.detection.saddles.response import GreyImage
from rigkit.detection.subpixel.edge_curvature import CURVED_RAD, DECAY, FREE, LINE_REACH, MIN_CORNER_SIGMA_PX
from rigkit.detection.subpixel.edge_fit import (
    ANGLE_SIGMA_RAD,
    BLUR_LAG,
    BLUR_RANGE,
    FIT_RIDGE,
    LIGHT_SIGMA_PER_PX,
    LOG_BLUR_SIGMA,
    MAX_BLUR_CHANGE,
    MAX_LIGHT_CHANGE,
    MAX_MIRRORED_PX,
    MAX_MOVE_PX,
    MAX_TURN_RAD,
    MIN_MIRRORED,
    VALID_MOVE_CELLS,
    VALID_MOVE_PX,
)
from rigkit.detection.subpixel.edge_model import NEAR_PX, TAIL_SIGMAS, WINDOW_REACH, Geometry
from rigkit.detection.tags.corners import NOTHING_NEAR_PX
from rigkit.kernels.edges import LAGS, CornerWindows, CurvatureRules, Rules, TagWindow
from rigkit.kernels.surface import TagSurface

MIN_DETERMINED_PIXELS = K1
"""So many parameters only the pixels determine; the curvatures of the lines are mostly the lattice's."""

START_BLOCK = 64
"""Brightness and contrast to start from are those of every second block of so many pixels, the compiled fit's."""

COEFFICIENTS = 6
"""Of the lines of a lattice, of order 0 to 5."""


def fit_corners(image: GreyImage, windows: CornerWindows, rules: Rules) -> FloatArray:
    w, pixels, loose = windows, windows.pixels, windows.curvature_sigma
    geometry = Geometry(
        w.sides, w.curvature, w.gaps, w.ends, reach=w.reach, paper=w.paper, tilts=w.tilts, single=w.single
    )
    window = collect(image, pixels, geometry, w.window_blur, rules.radius_px)
    prior_mean, prior = _prior(geometry, loose, w.blur, window.size)
    kept = np.count_nonzero(loose > 0.0, axis=1) < 2
    values = prior_mean.copy()
    values[:, [X, Y]] = pixels - window.centre
    _brightness(values, window, geometry, w.sign, w.contrast)
    used = window.weight.sum(axis=1, dtype=np.float64)
    free = np.maximum(used - MIN_DETERMINED_PIXELS, 1.0)
    variance = np.full(len(pixels), np.inf)
    normal = np.zeros((len(pixels), PARAMETERS, PARAMETERS))
    rest = np.zeros(window.weight.shape)
    active = np.ones(len(pixels), bool)
    diagonal = range(PARAMETERS)
    for turn in range(rules.iterations):
        every = bool(active.all())
        rows = linearise(
            values[active], window if every else window.of(active), geometry if every else _of(geometry, active)
        )
        rows[kept[active], K1 : K2 + 1] = 0.0
        products = (rows @ np.swapaxes(rows, 1, 2)).astype(np.float64)
        variance[active] = np.maximum(products[:, -1, -1] / free[active], rules.min_variance)
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
        settled = change.max(axis=1) <= rules.converged_px
        # What was left before a first step that found the brightness is no residual.
        settled &= (turn > 0) | np.isnan(w.contrast[active])
        active[np.flatnonzero(active)[settled]] = False
        if not active.any():
            break
    noise, lags = variance, np.zeros((2, len(pixels), len(LAGS)))
    if rules.mirrored:
        variance = np.maximum((rest**2).sum(axis=1) / free, rules.min_variance)
        noise, lags = _noise(values, variance, window, rest)
        lags[:, noise <= rules.min_variance] = 0.0
        noise = np.maximum(noise, rules.min_variance)
    return _result(values, variance, noise, lags, normal, window, pixels, geometry, w.sign)


def line_curvatures(
    pixels: FloatArray, sigma_px: FloatArray, cells: BoolArray, sides_px: FloatArray, rules: CurvatureRules
) -> tuple[FloatArray, FloatArray]:
    steps = np.arange(-LINE_REACH, LINE_REACH + 1)
    design = steps[:, None].astype(np.float64) ** np.arange(COEFFICIENTS)
    products = (design[:, :, None] * design[:, None, :]).reshape(len(steps), -1)
    decay = DECAY ** np.arange(COEFFICIENTS)
    known = np.isfinite(sigma_px) & np.isfinite(pixels[..., 0])
    weight = np.where(known, np.maximum(sigma_px, MIN_CORNER_SIGMA_PX) ** -2.0, 0.0)
    row, column = np.nonzero(cells)
    out, out_sigma = np.empty((2, len(row), 2))
    for line, (along_row, along_column) in enumerate(((0, 1), (1, 0))):
        r, c = row[:, None] + along_row * steps, column[:, None] + along_column * steps
        inside = (r >= 0) & (r < pixels.shape[0]) & (c >= 0) & (c < pixels.shape[1])
        r, c = np.where(inside, r, row[:, None]), np.where(inside, c, column[:, None])
        side = sides_px[:, line, None]
        weights = np.where(inside, weight[r, c], 0.0) * side**2
        off = np.where((weights > 0.0)[..., None], pixels[r, c] - pixels[row, column][:, None], 0.0) / side[..., None]
        normal = (weights @ products).reshape(-1, COEFFICIENTS, COEFFICIENTS)
        right = design.T @ (weights[..., None] * off)
        found, sigma = _most_probable(normal, right, np.broadcast_to(decay, (len(row), COEFFICIENTS)))
        size = np.linalg.norm(found, axis=2)
        turn = np.maximum(2.0 * size[:, 2], np.sqrt(2.0 * size[:, 3]))
        bent = turn > CURVED_RAD
        if bent.any():
            expected: FloatArray = np.repeat(decay[None], np.count_nonzero(bent), axis=0)
            expected[:, 2:] = np.maximum(decay[2:], 0.5 * turn[bent, None] ** np.arange(1, COEFFICIENTS - 1))
            found[bent], sigma[bent] = _most_probable(normal[bent], right[bent], expected)
        first, second = found[:, 1], 2.0 * found[:, 2]
        cross = first[:, 0] * second[:, 1] - first[:, 1] * second[:, 0]
        square = np.maximum((first**2).sum(axis=1), 1e-12)
        out[:, line] = cross / (square**1.5 * sides_px[:, line])
        out_sigma[:, line] = 2.0 * sigma / (square * sides_px[:, line])
    return out, out_sigma


def _of(geometry: Geometry, keep: BoolArray) -> Geometry:
    return geometry.of(keep)


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
) -> FloatArray:
    covariance = np.linalg.inv(normal) * noise[:, None, None]
    pixels = window.centre + values[:, [X, Y]]
    spread = 0.5 * (covariance[:, X, X] + covariance[:, Y, Y])
    moved = np.linalg.norm(pixels - start, axis=1)
    longest = np.linalg.norm(geometry.sides, axis=2).max(axis=1)
    valid = (moved < np.maximum(VALID_MOVE_PX, VALID_MOVE_CELLS * longest)) & (spread > 0.0) & np.isfinite(spread)
    valid &= (window.weight.sum(axis=1) > MIN_DETERMINED_PIXELS) & _surrounded(pixels, window)
    single = (
        np.sqrt(np.where(valid, spread, 0.0)),
        values[:, S],
        2.0 * values[:, B] * sign,
        np.sqrt(variance),
        np.sqrt(noise),
        valid,
        window.weight.sum(axis=1, dtype=np.float64),
    )
    return np.concatenate([pixels, np.stack(single, axis=1), *lags], axis=1)


def _most_probable(normal: FloatArray, right: FloatArray, expected: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the coefficients (M, K, 2) that are `expected` (M, K) in size, and the second's sigma (M,)."""
    prior = np.diag([FREE, FREE, *[1.0] * (COEFFICIENTS - 2)])
    inverse = np.linalg.inv(normal * expected[:, :, None] * expected[:, None, :] + prior)
    found = expected[..., None] * (inverse @ (expected[..., None] * right))
    return found, expected[:, 2] * np.sqrt(inverse[:, 2, 2])


def fit_tag_corners(
    image: GreyImage,
    cells: BoolArray,
    steps: FloatArray,
    signs: FloatArray,
    pixels: FloatArray,
    surface: FloatArray,
    single: FloatArray,
    contrast: FloatArray,
    blur: FloatArray,
    window: TagWindow,
    rules: Rules,
) -> FloatArray:
    assert (window.blurs, window.nothing_near) == (MARKER_BLURS, NOTHING_NEAR_PX)
    shape, own = TagSurface(surface), steps[cells]
    expected = np.clip(blur, *BLUR_RANGE)
    narrow = (window.border * shape.heights.min(axis=1) - MARKER_BLURS * blur - NEAR_PX) / TAIL_SIGMAS
    gaps = np.where(single[:, :1, None] == 0.0, own * shape.heights[:, :, None], NOTHING_NEAR_PX)
    none = np.zeros(gaps.shape)
    windows = CornerWindows(
        *(pixels, shape.sides, shape.curvature, np.zeros((len(pixels), 2)), gaps, none),
        *(np.minimum(0.5 * own, WINDOW_REACH), np.full(gaps.shape, np.nan), single, signs[cells], expected),
        *(np.minimum(np.maximum(narrow, BLUR_RANGE[0]), expected), contrast, none > 0.0),
    )
    return fit_corners(image, windows, rules)


def blur_of_tags(
    image: GreyImage,
    cells: BoolArray,
    steps: FloatArray,
    signs: FloatArray,
    pixels: FloatArray,
    surface: FloatArray,
    single: FloatArray,
    contrast: FloatArray,
    apart: int,
    blur: float,
    window: TagWindow,
    rules: Rules,
) -> float:
    few = np.arange(len(pixels)) % apart == 0
    some = cells.copy()
    some[cells] = few
    fitted = fit_tag_corners(
        *(image, some, steps, signs, pixels[few], surface[few], single[few], contrast[few]),
        *(np.full(np.count_nonzero(few), blur), window, rules),
    )
    good = (fitted[:, 7] > 0.5) & (fitted[:, 4] > 0.0)
    return float(np.median(fitted[good, 3])) if good.any() else float("nan")
