"""The model of two crossing edges in numpy: its pixels, its brightness and the derivatives of that.

Arrays of pixels are float32: N corners x P pixels x 11 derivatives, of values 0..255.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import erf

from rigkit.core.arrays import BoolArray, FloatArray
from rigkit.detection.saddles.response import GreyImage
from rigkit.detection.subpixel.edge_model import (
    END_SIGMAS,
    MIN_REACH,
    NEAR_PX,
    PAPER_SIGMAS,
    PIXEL_KURTOSIS,
    SHARP_BLUR_PX,
    TAIL_SIGMAS,
    WINDOW_REACH,
    Geometry,
)

Float32 = NDArray[np.float32]

PARAMETERS = 11

X, Y, T1, T2, S, A, B, GX, GY, K1, K2 = range(PARAMETERS)


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
    near = TAIL_SIGMAS * blur + NEAR_PX
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
    orders = (erf(x * np.float32(np.sqrt(0.5))) - third, slope, bow, curl, x * slope - np.float32(4.0) * third)
    return tuple(np.asarray(order, np.float32) for order in orders)


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
        along, lateral = cosine * qu + sine * qv, cosine * qv - sine * qu
        kappa = known[:, bend, None]
        distance = lateral - (np.float32(0.5) * kappa) * (along * along + blur * blur)
        flat = np.float32(PIXEL_KURTOSIS) * (cosine**4 + sine**4)
        beside = (geometry.gaps[:, line].astype(np.float32), _paper(geometry)[:, line].astype(np.float32))
        tilts = np.zeros((len(qu), 2)) if geometry.tilts is None else geometry.tilts[:, line]
        before, after = (tilt[:, None].astype(np.float32) * along for tilt in tilts.T)
        around = ((before, after), blur, flat, *beside)
        step, beyond = _step(distance, *around), _beyond(distance, *around)
        for slope, grown in ((step[1], step[4]), (beyond[1], beyond[2]), (beyond[4], beyond[5])):
            grown[...] += kappa * blur * slope
        out.append((*step, along, lateral, cosine, sine, kappa, beyond))
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
