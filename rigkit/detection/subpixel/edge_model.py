"""The brightness around a chessboard corner as a model of eleven parameters.

    I(p) = (1 + g . (p - c)) (a + b S(d1 / s) S(d2 / s))

with d1, d2 the distances of pixel p from the two lines through the corner (with curvatures, so that a fisheye's bent
rows do not pull the corner aside), S the step of an edge as a Gaussian lens and the square of a pixel blur it, of
standard deviation s together, a and b brightness and half contrast, g the gradient of the light. Parameters: corner
(2), angles of the lines (2), s, a, b, g (2), curvatures (2).

The model is symmetric about the corner but for curvature and light, so what it gets wrong otherwise (the shape of the
blur, sharpening) does not move the corner; but it adds to the residuals, and so to the predicted sigma.

Arrays are float32 here, the one place besides image filters: N corners x P pixels x 11 derivatives, of values 0..255,
summed in products of P terms; the corner is good to 1e-5 px.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rigkit.core.arrays import BoolArray, FloatArray
from rigkit.detection.saddles.response import GreyImage

__all__ = [
    "END_SIGMAS",
    "MIN_REACH",
    "NEAR_PX",
    "NEAR_SIGMAS",
    "PARAMETERS",
    "PIXEL_KURTOSIS",
    "SHARP_BLUR_PX",
    "TAIL_SIGMAS",
    "WINDOW_REACH",
    "Geometry",
    "Window",
    "collect",
    "ends_of",
    "linearise",
    "pattern_of",
]

Float32 = NDArray[np.float32]

PARAMETERS = 11
X, Y, T1, T2, S, A, B, GX, GY, K1, K2 = range(PARAMETERS)

TAIL_SIGMAS = 3.0
"""An edge is felt so far away, s: the edges of the neighbouring lines are reckoned with where they are nearer."""

PIXEL_KURTOSIS = -1.0 / 120.0
"""Fourth cumulant of a uniform distribution of width 1: of a pixel's square along its sides, px^4."""

SHARP_BLUR_PX = 0.6
"""Below this s the pixel's square shows: a series in its cumulants would be wrong by half a grey level at s = 0.4."""

WINDOW_REACH = 0.5
"""Pixels are used up to this from the corner along the sides of its cell: the windows of neighbouring corners meet and
do not overlap, so that every pixel is used and the errors of neighbours are independent."""

NEAR_SIGMAS, NEAR_PX = 3.0, 1.5
"""Pixels are used so near to one of the lines (s and px added up): those beyond only repeat how bright squares are."""

END_SIGMAS = 2.5
MIN_REACH = 0.25
"""Where the lattice ends, what lies behind the next line is not known: paper, a narrow margin, another square. Pixels
nearer to that line, s, are left out, but never those so near to the corner, in cells."""


@dataclass(frozen=True, eq=False, slots=True)
class Geometry:
    """What the lattice says of N corners.

    Attributes
    ----------
    sides : (N, 2, 2) the cell's sides along column and row, px: directions of line 1 and 2, and the window.
    curvature : (N, 2) of the two lines, 1/px, positive towards +90 degrees.
    gaps : (N, 2, 2) distance of the neighbouring lines before and after line 1 and line 2 (along +90 degrees), px.
    ends : (N, 2, 2) whether the lattice has no corner on that line beside this one.
    """

    sides: FloatArray
    curvature: FloatArray
    gaps: FloatArray
    ends: BoolArray

    def of(self, keep: BoolArray) -> Geometry:
        return Geometry(self.sides[keep], self.curvature[keep], self.gaps[keep], self.ends[keep])

    def reach(self, blur: FloatArray) -> FloatArray:
        """Return (N, 2, 2) how far the window reaches, in cells: along both sides, backwards and forwards."""
        left = 1.0 - END_SIGMAS * blur[:, None, None] / np.maximum(self.gaps, 1e-9)
        out = np.where(self.ends, np.clip(left, MIN_REACH, WINDOW_REACH), WINDOW_REACH)
        # +90 degrees from line 1, which runs along the first side, is forwards along the second; from line 2 backwards.
        return np.stack([out[:, 1, ::-1], out[:, 0]], axis=1)


def ends_of(known: BoolArray, cells: BoolArray) -> BoolArray:
    """Return the `ends` (M, 2, 2) of the `cells` of a lattice whose corners (R, C) are `known`."""
    ends = np.ones((*known.shape, 4), np.bool_)
    unknown = ~known
    ends[1:, :, 0], ends[:-1, :, 1] = unknown[:-1], unknown[1:]
    ends[:, :-1, 2], ends[:, 1:, 3] = unknown[:, 1:], unknown[:, :-1]
    return ends[cells].reshape(-1, 2, 2)


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
    limits = geometry.reach(blur).astype(np.float32)
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


def _step(distance: Float32, blur: Float32, flat: Float32, gaps: Float32) -> tuple[Float32, ...]:
    """Return the blurred step S over the line, S', S'', S''' (with respect to x = distance / s), and -s dS/ds.

    Where squares are small against the blur, the edges of the parallel lines at `gaps` (N, 2) before and after reach
    into the window: their steps are taken away. Far from both they add up to nothing: one is -1, the other +1.
    """
    total = _edge(distance, blur, flat)
    tight = (gaps * (1.0 - WINDOW_REACH) < TAIL_SIGMAS * blur).any(axis=1)
    if tight.any():
        near, beside = distance[tight], gaps[tight]
        for place in (-beside[:, :1], beside[:, 1:]):
            for mine, other in zip(total, _edge(near - place, blur[tight], flat[tight]), strict=True):
                mine[tight] -= other
    return total


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
    from scipy.special import erf

    one, three, six, ten, fifteen = (np.float32(c) for c in (1.0, 3.0, 6.0, 10.0, 15.0))
    square = x * x
    density = np.float32(np.sqrt(2.0 / np.pi)) * np.exp(np.float32(-0.5) * square)
    part = kurtosis / np.float32(24.0)
    third = part * x * (square - three) * density
    slope = density * (one + part * (square * (square - six) + three))
    bow = -density * x * (one + part * (square * (square - ten) + fifteen))
    curl = density * (square - one)
    return erf(x * np.float32(np.sqrt(0.5))) - third, slope, bow, curl, x * slope - np.float32(4.0) * third


def _parts(values: FloatArray, window: Window, geometry: Geometry) -> tuple[tuple[Float32, ...], ...]:
    """Return for line 1 and line 2: S, S', S'', S''', -s dS/ds, along, aside, cosine, sine, curvature; (N, P), (N, 1).

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
        step = _step(distance, blur, flat, geometry.gaps[:, line].astype(np.float32))
        step[4][...] += kappa * blur * step[1]
        out.append((*step, along, aside, cosine, sine, kappa))
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
    f1, slope1, bow1, curl1, grown1, along1, aside1, cos1, sin1, kappa1 = one
    f2, slope2, bow2, curl2, grown2, along2, aside2, cos2, sin2, kappa2 = two
    half_square = np.float32(0.5) * rho * rho
    known = values.astype(np.float32)
    weight = window.weight
    pattern = _mixed(one, two, rho)
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
    bend1, bend2 = kappa1 * along1, kappa2 * along2
    rows[:, X] = by_d1 * (sin1 + bend1 * cos1) + by_d2 * (sin2 + bend2 * cos2)
    rows[:, Y] = by_d1 * (bend1 * sin1 - cos1) + by_d2 * (bend2 * sin2 - cos2)
    rows[:, T1] = -by_d1 * (along1 + bend1 * aside1)
    rows[:, T2] = -by_d2 * (along2 + bend2 * aside2)
    rows[:, S] = -light * (grown1 * f2 + grown2 * f1)
    rows[:, K1] = np.float32(-0.5) * by_d1 * (along1 * along1 + known[:, S, None] ** 2)
    rows[:, K2] = np.float32(-0.5) * by_d2 * (along2 * along2 + known[:, S, None] ** 2)
    return rows
