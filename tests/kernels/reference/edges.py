"""What the detector asks the kernels of edges.c for, in numpy; arguments as those of `rigkit.kernels.edges`.

The constants of the model are those of the detector, whatever the rules say. Arrays of pixels are float32: N corners x
P pixels x 11 derivatives, of values 0..255, summed in products of P terms; the corner is good to 1e-5 px.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import erf

from rigkit.core.arrays import BoolArray, FloatArray
from rigkit.detection.saddles.response import GreyImage
from rigkit.detection.subpixel.edge_curvature import BENT_RAD, DECAY, FREE, LINE_REACH, MIN_CORNER_SIGMA_PX
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
from rigkit.detection.subpixel.edge_model import (
    END_SIGMAS,
    MIN_REACH,
    NEAR_PX,
    NEAR_SIGMAS,
    PAPER_SIGMAS,
    PIXEL_KURTOSIS,
    SHARP_BLUR_PX,
    TAIL_SIGMAS,
    WINDOW_REACH,
    Geometry,
)
from rigkit.kernels.edges import LAGS, BendRules, Rules

Float32 = NDArray[np.float32]

PARAMETERS = 11
X, Y, T1, T2, S, A, B, GX, GY, K1, K2 = range(PARAMETERS)

MIN_DETERMINED_PIXELS = K1
"""So many parameters only the pixels determine; the curvatures of the lines are mostly the lattice's."""

START_BLOCK = 64
"""Brightness and contrast to start from are those of every second block of so many pixels, the compiled fit's."""

COEFFICIENTS = 6
"""Of the lines of a lattice, of order 0 to 5."""


def fit_corners(
    image: GreyImage,
    pixels: FloatArray,
    sides: FloatArray,
    curvature: FloatArray,
    curvature_sigma: FloatArray,
    gaps: FloatArray,
    tilts: FloatArray,
    reach: FloatArray,
    paper: FloatArray,
    single: FloatArray,
    ends: BoolArray,
    sign: FloatArray,
    blur: FloatArray,
    contrast: FloatArray,
    rules: Rules,
) -> FloatArray:
    geometry, loose = (
        Geometry(sides, curvature, gaps, ends, reach=reach, paper=paper, tilts=tilts, single=single),
        curvature_sigma,
    )
    window = collect(image, pixels, geometry, blur, rules.radius_px)
    prior_mean, prior = _prior(geometry, loose, blur, window.size)
    kept = np.count_nonzero(loose > 0.0, axis=1) < 2
    values = prior_mean.copy()
    values[:, [X, Y]] = pixels - window.centre
    _brightness(values, window, geometry, sign, contrast)
    used = window.weight.sum(axis=1, dtype=np.float64)
    free = np.maximum(used - MIN_DETERMINED_PIXELS, 1.0)
    variance = np.full(len(pixels), np.inf)
    normal = np.zeros((len(pixels), PARAMETERS, PARAMETERS))
    rest = np.zeros(window.weight.shape)
    active = np.ones(len(pixels), bool)
    diagonal = range(PARAMETERS)
    for _ in range(rules.iterations):
        every = bool(active.all())
        rows = linearise(
            values[active], window if every else window.of(active), geometry if every else _of(geometry, active)
        )
        rows[kept[active], K1 : K2 + 1] = 0.0
        products = (rows @ np.swapaxes(rows, 1, 2)).astype(np.float64)
        variance[active] = np.maximum(products[:, -1, -1] / free[active], rules.least_variance)
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
        active[np.flatnonzero(active)[change.max(axis=1) <= rules.converged_px]] = False
        if not active.any():
            break
    noise, lags = variance, np.zeros((2, len(pixels), len(LAGS)))
    if rules.mirrored:
        variance = np.maximum((rest**2).sum(axis=1) / free, rules.least_variance)
        noise, lags = _noise(values, variance, window, rest)
        lags[:, noise <= rules.least_variance] = 0.0
        noise = np.maximum(noise, rules.least_variance)
    return _result(values, variance, noise, lags, normal, window, pixels, geometry, sign)


def line_bends(
    pixels: FloatArray, sigma_px: FloatArray, cells: BoolArray, sides_px: FloatArray, rules: BendRules
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
        bent = turn > BENT_RAD
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


def _reach(geometry: Geometry, blur: FloatArray) -> FloatArray:
    """Return (N, 2, 2) how far the window reaches, in cells: along both sides, backwards and forwards."""
    a, b = np.moveaxis(geometry.sides, 1, 0)
    area = np.maximum(np.abs(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]), 1.0)
    # Of the cell across line 1, and across line 2.
    wide = np.stack([area / np.hypot(*a.T), area / np.hypot(*b.T)], axis=1)[..., None]
    sigmas = np.where(np.isfinite(_paper(geometry)), PAPER_SIGMAS, END_SIGMAS)
    left = np.maximum(geometry.gaps - sigmas * blur[:, None, None], MIN_REACH * geometry.gaps) / wide
    out = np.where(geometry.ends, np.minimum(left, WINDOW_REACH), WINDOW_REACH)
    if geometry.reach is not None:
        out = np.where(np.isfinite(geometry.reach), np.minimum(geometry.reach, WINDOW_REACH), out)
    # +90 degrees from line 1, which runs along the first side, is forwards along the second; from line 2 backwards.
    return np.stack([out[:, 1, ::-1], out[:, 0]], axis=1)


def _paper(geometry: Geometry) -> FloatArray:
    """Return (N, 2, 2) the `paper` of `geometry`, NaN where there is none."""
    return np.full(geometry.gaps.shape, np.nan) if geometry.paper is None else geometry.paper


@dataclass(frozen=True, eq=False, slots=True)
class Window:
    """The pixels of each corner, (N, P), relative to `centre` (N, 2); weight 0 is padding. Light is per `size` (N,)."""

    centre: FloatArray
    u: Float32
    v: Float32
    value: Float32
    weight: Float32
    size: FloatArray

    def of(self, keep: BoolArray) -> Window:
        return Window(*(getattr(self, name)[keep] for name in Window.__slots__))


def collect(image: GreyImage, pixels: FloatArray, geometry: Geometry, blur: FloatArray, radius_px: float) -> Window:
    """Return the pixels of `image` near the two lines of each corner, inside its cell and `radius_px`."""
    height, width = image.shape
    a, b = geometry.sides[:, 0], geometry.sides[:, 1]
    radius = np.minimum(WINDOW_REACH * (np.abs(a) + np.abs(b)).max(axis=1), radius_px)
    reach = int(np.ceil(radius.max(initial=2.0)))
    offset = np.arange(-reach, reach + 1)
    du, dv = (o.ravel() for o in np.meshgrid(offset, offset))
    disc = du**2 + dv**2 <= radius_px**2
    du, dv = du[disc], dv[disc]
    centre = np.round(pixels)
    off = pixels - centre
    area = a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]
    area = np.where(np.abs(area) > 1.0, area, 1.0)
    # Position of each pixel in cells along both sides, as one product with (du, dv, 1).
    rows = np.stack([b[:, 1], -b[:, 0], -a[:, 1], a[:, 0]], axis=1).reshape(-1, 2, 2) / area[:, None, None]
    rows = np.concatenate([rows, -rows @ off[:, :, None]], axis=2).astype(np.float32)
    cells = rows @ np.stack([du, dv, np.ones_like(du)]).astype(np.float32)
    limits = _reach(geometry, blur).astype(np.float32)
    inside: BoolArray = np.all((cells >= -limits[:, :, :1]) & (cells <= limits[:, :, 1:]), axis=1)
    near = NEAR_SIGMAS * blur + NEAR_PX
    far = np.stack([np.linalg.norm(b, axis=1), np.linalg.norm(a, axis=1)], axis=1) * (near / np.abs(area))[:, None]
    inside &= (np.abs(cells) <= far[:, :, None].astype(np.float32)).any(axis=1)
    at_frame = ((centre < reach) | (centre > np.array([width, height]) - 1 - reach)).any(axis=1)
    if at_frame.any():
        column, row = du + centre[at_frame, :1], dv + centre[at_frame, 1:]
        inside[at_frame] &= (column >= 0) & (column < width) & (row >= 0) & (row < height)
    owner, which = np.nonzero(inside)
    count = np.bincount(owner, minlength=len(pixels))
    place = np.arange(len(owner)) - np.repeat(np.cumsum(count) - count, count)
    index = np.full((len(pixels), max(int(count.max(initial=1)), 1)), -1)
    index[owner, place] = which
    weight = (index >= 0).astype(np.float32)
    u, v = du[index], dv[index]
    column = np.clip(u + centre[:, :1].astype(np.int64), 0, width - 1)
    row = np.clip(v + centre[:, 1:].astype(np.int64), 0, height - 1)
    value = image[row, column].astype(np.float32)
    return Window(centre, u.astype(np.float32), v.astype(np.float32), value, weight, np.maximum(radius, 2.0))


def _step(
    distance: Float32, turned: tuple[Float32, Float32], blur: Float32, flat: Float32, gaps: Float32, paper: Float32
) -> tuple[Float32, ...]:
    """Return the blurred step S over the line, S', S'', S''' (with respect to x = distance / s), and -s dS/ds.

    Where squares are small against the blur, the edges of the neighbouring lines at `gaps` (N, 2) before and after,
    and `turned` (N, P) further off, reach into the window: their steps are taken away. Far from both they add up to
    nothing: one is -1, the other +1. Where there is `paper` (N, 2) beyond, the pattern ends: half of the step is taken
    away, and S is 0 there.
    """
    total = _edge(distance, blur, flat)
    papered = np.isfinite(paper)
    tight = (gaps * (1.0 - WINDOW_REACH) < TAIL_SIGMAS * blur).any(axis=1) | papered.any(axis=1)
    if tight.any():
        near, beside = distance[tight], gaps[tight]
        parts = np.where(papered[tight], 0.5, 1.0).astype(np.float32)
        places = (-beside[:, :1], parts[:, :1], turned[0]), (beside[:, 1:], parts[:, 1:], turned[1])
        for place, part, off in places:
            for mine, other in zip(total, _edge(near - off[tight] - place, blur[tight], flat[tight]), strict=True):
                mine[tight] -= part * other
        total[0][tight] += parts[:, :1] - parts[:, 1:]
    return total


def _beyond(
    distance: Float32, turned: tuple[Float32, Float32], blur: Float32, flat: Float32, gaps: Float32, paper: Float32
) -> tuple[Float32, ...]:
    """Return how much each pixel sees of what lies beyond the ends of a line that have `paper`, the derivative of that
    with respect to x, and -s d/ds of it; then the same of it times the paper's brightness."""
    seen = tuple(np.zeros_like(distance) for _ in range(6))
    sides = (-gaps[:, :1], -1.0, paper[:, :1], turned[0]), (gaps[:, 1:], 1.0, paper[:, 1:], turned[1])
    for place, way, bright, off in sides:
        known = np.isfinite(bright)
        half = np.where(known, 0.5 * way, 0.0).astype(np.float32)
        edge = _edge(distance - off - place, blur, flat)
        parts = (np.where(known, np.float32(0.5), np.float32(0.0)) + half * edge[0], half * edge[1], half * edge[4])
        for mine, mine_bright, part in zip(seen[:3], seen[3:], parts, strict=True):
            mine += part
            mine_bright += np.where(known, bright, 0.0).astype(np.float32) * part
    return seen


def _edge(distance: Float32, blur: Float32, flat: Float32) -> tuple[Float32, ...]:
    """Return, as `_step`, a single edge from -1 to 1; `flat` (N, 1) is the pixel's fourth cumulant across it, px^4.

    Sharp edges are the mean of two Gaussian ones at +-r, which have the pixel's second and fourth cumulant: -2 r^4.
    """
    total = _blurred_edge(distance / blur, flat / blur**4)
    sharp = blur[:, 0] < SHARP_BLUR_PX
    if sharp.any():
        half, apart = np.float32(0.5), np.sqrt(np.sqrt(np.float32(-0.5) * flat[sharp]))
        width = np.sqrt(blur[sharp] ** 2 - apart**2)
        before, after = (_blurred_edge((distance[sharp] + r) / width, np.zeros_like(width)) for r in (-apart, apart))
        for order, mine, one, other in zip((0, 1, 2, 3, 2), total, before, after, strict=True):
            mine[sharp] = half * (blur[sharp] / width) ** order * (one + other)
    return total


def _blurred_edge(x: Float32, kurtosis: Float32) -> tuple[Float32, ...]:
    """Return, as `_step`, an edge from -1 to 1 at x = 0, blurred to standard deviation 1 and excess `kurtosis`.

    The first terms of Edgeworth's series: S = erf(x / sqrt 2) - k / 24 He3 p, with p twice the normal density. k goes
    with s^-4, so -s dS/ds = x S' - k / 6 He3 p. S''' is that of the Gaussian alone: it only matters where lines cross
    aslant.
    """
    one, three, six, ten, fifteen = (np.float32(c) for c in (1.0, 3.0, 6.0, 10.0, 15.0))
    square = x * x
    density = np.float32(np.sqrt(2.0 / np.pi)) * np.exp(np.float32(-0.5) * square)
    part = kurtosis / np.float32(24.0)
    third = part * x * (square - three) * density
    slope = density * (one + part * (square * (square - six) + three))
    bow = -density * x * (one + part * (square * (square - ten) + fifteen))
    curl = density * (square - one)
    return erf(x * np.float32(np.sqrt(0.5))) - third, slope, bow, curl, x * slope - np.float32(4.0) * third


def _parts(values: FloatArray, window: Window, geometry: Geometry) -> tuple[tuple[Any, ...], ...]:
    """Return for line 1 and line 2: S, S', S'', S''', -s dS/ds, along, aside, cosine, sine, curvature; (N, P), (N, 1);
    and what `_beyond` does.

    Blur pulls a bent edge towards the inside of the bend: the mean of curvature / 2 t^2 along it is curvature / 2 s^2.
    """
    known = values.astype(np.float32)
    blur = known[:, S, None]
    qu, qv = window.u - known[:, X, None], window.v - known[:, Y, None]
    out = []
    for angle, bend, line in ((T1, K1, 0), (T2, K2, 1)):
        cosine, sine = np.cos(known[:, angle, None]), np.sin(known[:, angle, None])
        along, aside = cosine * qu + sine * qv, cosine * qv - sine * qu
        kappa = known[:, bend, None]
        distance = aside - (np.float32(0.5) * kappa) * (along * along + blur * blur)
        flat = np.float32(PIXEL_KURTOSIS) * (cosine**4 + sine**4)
        beside = (geometry.gaps[:, line].astype(np.float32), _paper(geometry)[:, line].astype(np.float32))
        tilts = np.zeros((len(qu), 2)) if geometry.tilts is None else geometry.tilts[:, line]
        before, after = (tilt[:, None].astype(np.float32) * along for tilt in tilts.T)
        around = ((before, after), blur, flat, *beside)
        step, beyond = _step(distance, *around), _beyond(distance, *around)
        for slope, grown in ((step[1], step[4]), (beyond[1], beyond[2]), (beyond[4], beyond[5])):
            grown[...] += kappa * blur * slope
        out.append((*step, along, aside, cosine, sine, kappa, beyond))
    return tuple(out)


def pattern_of(values: FloatArray, window: Window, geometry: Geometry) -> Float32:
    """Return S S of the model, (N, P), between -1 (dark) and +1 (bright)."""
    one, two = _parts(values, window, geometry)
    return _mixed(one, two, _oblique(values))


def _oblique(values: FloatArray) -> Float32:
    rho: Float32 = np.cos(values[:, T1] - values[:, T2])[:, None].astype(np.float32)
    return rho


def _mixed(one: tuple[Float32, ...], two: tuple[Float32, ...], rho: Float32) -> Float32:
    """Return the blurred product of the two steps.

    The blur mixes them where the lines cross aslant: for a Gaussian, E[sign d1 sign d2] is the sum over k of
    rho^k / k! S1^(k) S2^(k) (Mehler), rho the cosine between the lines; three terms are kept. Brightness grows with the
    angle across line 1: that is d1 > 0, d2 < 0 bright.
    """
    mixed = one[0] * two[0]
    mixed += rho * one[1] * two[1]
    mixed += (np.float32(0.5) * rho * rho) * one[2] * two[2]
    mixed += (np.float32(1.0 / 6.0) * rho * rho * rho) * one[3] * two[3]
    return np.asarray(np.negative(mixed, out=mixed), np.float32)


def linearise(values: FloatArray, window: Window, geometry: Geometry) -> Float32:
    """Return the derivatives (N, 11, P) of the brightness and, as a twelfth row, the residuals; zero in the padding.

    How the blur mixes lines that cross aslant is differentiated to second order in their cosine.
    """
    one, two = _parts(values, window, geometry)
    rho = _oblique(values)
    f1, slope1, bow1, curl1, grown1, along1, aside1, cos1, sin1, kappa1, beyond1 = one
    f2, slope2, bow2, curl2, grown2, along2, aside2, cos2, sin2, kappa2, beyond2 = two
    # Beyond both lines, half of what lies beyond each.
    half = np.float32(0.5)
    rest1, rest2 = np.float32(1.0) - half * beyond1[0], np.float32(1.0) - half * beyond2[0]
    half_square = np.float32(0.5) * rho * rho
    known = values.astype(np.float32)
    weight = window.weight
    single1, single2 = _single(geometry, len(values))
    pattern = _mixed(one, two, rho) + beyond1[3] * rest2 + beyond2[3] * rest1 - single2 * f1 - single1 * f2
    plain = known[:, A, None] + known[:, B, None] * pattern
    size = window.size[:, None].astype(np.float32)
    light = (known[:, GX, None] / size) * window.u + (known[:, GY, None] / size) * window.v
    light += np.float32(1.0)
    rows = np.empty((len(values), PARAMETERS + 1, weight.shape[1]), np.float32)
    rows[:, PARAMETERS] = (window.value - light * plain) * weight
    light *= weight
    rows[:, A] = light
    rows[:, B] = light * pattern
    plain *= weight / size
    rows[:, GX] = plain * window.u
    rows[:, GY] = plain * window.v
    light *= -(known[:, B] / known[:, S])[:, None]
    by_d1 = light * (slope1 * f2 + rho * bow1 * slope2 + half_square * curl1 * bow2)
    by_d2 = light * (slope2 * f1 + rho * bow2 * slope1 + half_square * curl2 * bow1)
    by_d1 -= light * (beyond1[4] * rest2 - half * beyond2[3] * beyond1[1])
    by_d2 -= light * (beyond2[4] * rest1 - half * beyond1[3] * beyond2[1])
    by_d1 += light * single2 * slope1
    by_d2 += light * single1 * slope2
    past1 = beyond1[5] * rest2 - half * beyond2[3] * beyond1[2]
    past2 = beyond2[5] * rest1 - half * beyond1[3] * beyond2[2]
    bend1, bend2 = kappa1 * along1, kappa2 * along2
    rows[:, X] = by_d1 * (sin1 + bend1 * cos1) + by_d2 * (sin2 + bend2 * cos2)
    rows[:, Y] = by_d1 * (bend1 * sin1 - cos1) + by_d2 * (bend2 * sin2 - cos2)
    rows[:, T1] = -by_d1 * (along1 + bend1 * aside1)
    rows[:, T2] = -by_d2 * (along2 + bend2 * aside2)
    alone = single2 * grown1 + single1 * grown2
    rows[:, S] = -light * (grown1 * f2 + grown2 * f1 + alone - past1 - past2)
    rows[:, K1] = np.float32(-0.5) * by_d1 * (along1 * along1 + known[:, S, None] ** 2)
    rows[:, K2] = np.float32(-0.5) * by_d2 * (along2 * along2 + known[:, S, None] ** 2)
    return rows


def _single(geometry: Geometry, count: int) -> Float32:
    """Return the `single` of `geometry`, (2, N, 1)."""
    single = np.zeros((count, 2)) if geometry.single is None else geometry.single
    return np.asarray(single.T[:, :, None], np.float32)


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
