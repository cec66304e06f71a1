"""The brightness around a chessboard corner as a model of nine parameters, fitted by maximum likelihood.

    I(p) = (1 + g . (p - c)) (a + b F(d1 / s) F(d2 / s))

with d1, d2 the distances of pixel p from the two lines through the corner (given curvatures, so that a fisheye's bent
rows do not pull the corner aside), F a smooth step of width s (blur and pixel together), a and b brightness and
half contrast, g the gradient of the light. Parameters: corner (2), angles of the lines (2), s, a, b, g (2). For noise
that is independent and equal in all pixels least squares is maximum likelihood, and reaches the Cramer-Rao bound.

The model is symmetric about the corner but for curvature and light, so what it gets wrong otherwise (the shape of the
blur, the exact form of the product where the lines cross aslant, sharpening) does not move the corner.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rigkit.arrays import BoolArray, FloatArray, IntArray
from rigkit.corners.response import FloatImage

__all__ = ["EdgeFit", "EdgeStart", "fit_edges"]

PARAMETERS = 9
X, Y, T1, T2, S, A, B, GX, GY = range(PARAMETERS)

STEP_WIDTH = 3.0
"""The step F rises within +-3 s: its slope (1 - u^2)^3 then has the standard deviation s."""

REACH = 0.44
"""Pixels are used up to this from the corner along the sides of its cell: short of the neighbouring edges."""

MAX_RADIUS_PX = 18.0

MARGIN_PX = 1.5
"""Pixels beyond the rise of the step that are used: they say how bright the squares are."""

ITERATIONS = 10
CONVERGED_PX = 2e-4

BLUR_RANGE = (0.28, 5.0)
"""s of a perfectly sharp image is the pixel's own 0.29; above 5 px there is no edge to speak of."""


@dataclass(frozen=True, eq=False, slots=True)
class EdgeStart:
    """Where the fit starts and what is known beforehand, for N corners.

    Attributes
    ----------
    pixels : (N, 2)
    sides : (N, 2, 2) the cell's sides along column and row, px: directions of line 1 and 2, and the window.
    curvature : (N, 2) of the two lines, 1/px, positive towards +90 degrees.
    gaps : (N, 2, 2) distance of the neighbouring lines before and after line 1 and line 2 (along +90 degrees), px.
    sign : (N,) +1 where brightness grows with the angle across the +column edge.
    blur : (N,) s.
    angle_sigma, log_blur_sigma, light_sigma : how well angles (rad), log s and g (1 per window) are known beforehand;
        these matter only where squares are so small that the pixels cannot tell.
    """

    pixels: FloatArray
    sides: FloatArray
    curvature: FloatArray
    gaps: FloatArray
    sign: FloatArray
    blur: FloatArray
    angle_sigma: float = 0.1
    log_blur_sigma: float = 0.7
    light_sigma: float = 0.3


@dataclass(frozen=True, eq=False, slots=True)
class EdgeFit:
    """The fitted corners.

    Attributes
    ----------
    pixels : (N, 2)
    sigma_px : (N,) predicted standard deviation per axis, from the residuals and the curvature of the likelihood.
    angles : (N, 2) rad of line 1 and 2, along the sides.
    blur : (N,) s, px.
    contrast : (N,) 2 b, negative if bright and dark are the other way round than expected.
    residual : (N,) root mean square, grey levels.
    used : (N,) number of pixels.
    valid : (N,) the fit converged near its start.
    """

    pixels: FloatArray
    sigma_px: FloatArray
    angles: FloatArray
    blur: FloatArray
    contrast: FloatArray
    residual: FloatArray
    used: IntArray
    valid: BoolArray


@dataclass(slots=True)
class _Window:
    """The pixels of each corner, (N, P), relative to `centre` (N, 2); weight 0 is padding. Light is per `size` (N,)."""

    centre: FloatArray
    u: FloatArray
    v: FloatArray
    value: FloatArray
    weight: FloatArray
    size: FloatArray

    def of(self, keep: BoolArray) -> _Window:
        return _Window(*(getattr(self, name)[keep] for name in ("centre", "u", "v", "value", "weight", "size")))


def fit_edges(image: FloatImage, start: EdgeStart) -> EdgeFit:
    """Fit the model to `image` (grey float32) around each corner of `start`, in pixels of that image."""
    count = len(start.pixels)
    window = _windows(image, start)
    angles = np.arctan2(start.sides[..., 1], start.sides[..., 0])
    prior_mean = np.zeros((count, PARAMETERS))
    prior_mean[:, T1], prior_mean[:, T2], prior_mean[:, S] = angles[:, 0], angles[:, 1], start.blur
    prior = np.zeros((count, PARAMETERS))
    prior[:, [T1, T2]] = start.angle_sigma**-2
    prior[:, S] = (start.log_blur_sigma * start.blur) ** -2
    prior[:, [GX, GY]] = start.light_sigma**-2
    values = prior_mean.copy()
    values[:, [X, Y]] = start.pixels - window.centre
    _brightness(values, window, start)
    variance = np.full(count, np.inf)
    normal = np.zeros((count, PARAMETERS, PARAMETERS))
    active = np.ones(count, bool)
    for _ in range(ITERATIONS):
        part = window.of(active) if not active.all() else window
        jacobian, residual = _linearise(values[active], part, start.curvature[active], start.gaps[active])
        free = np.maximum(part.weight.sum(axis=1) - PARAMETERS, 1.0)
        variance[active] = np.maximum((residual**2).sum(axis=1) / free, 1e-6)
        pull = prior[active] * variance[active, None]
        hessian = jacobian @ np.swapaxes(jacobian, 1, 2)
        hessian[:, range(PARAMETERS), range(PARAMETERS)] += pull + 1e-9
        gradient = (jacobian @ residual[..., None])[..., 0] + pull * (prior_mean - values)[active]
        step = np.linalg.solve(hessian, gradient[..., None])[..., 0]
        normal[active] = hessian
        values[active] += _limited(step, values[active])
        moving = np.abs(step[:, [X, Y]]).max(axis=1) > CONVERGED_PX
        active[np.flatnonzero(active)[~moving]] = False
        if not active.any():
            break
    return _result(values, variance, normal, window, start)


def _windows(image: FloatImage, start: EdgeStart) -> _Window:
    """Collect the pixels near the two lines, inside the cell."""
    height, width = image.shape
    a, b = start.sides[:, 0], start.sides[:, 1]
    radius = np.minimum(REACH * (np.abs(a) + np.abs(b)).max(axis=1), MAX_RADIUS_PX)
    reach = int(np.ceil(radius.max(initial=2.0))) + 1
    offset = np.arange(-reach, reach + 1)
    du, dv = (o.ravel() for o in np.meshgrid(offset, offset))
    centre = np.round(start.pixels)
    off = start.pixels - centre
    u, v = du - off[:, :1], dv - off[:, 1:]
    area = a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]
    area = np.where(np.abs(area) > 1.0, area, 1.0)
    along_a = (u * b[:, 1:] - v * b[:, :1]) / area[:, None]
    along_b = (a[:, :1] * v - a[:, 1:] * u) / area[:, None]
    near = STEP_WIDTH * start.blur + MARGIN_PX
    height_a = np.abs(area) / np.linalg.norm(b, axis=1)
    height_b = np.abs(area) / np.linalg.norm(a, axis=1)
    inside = (np.abs(along_a) <= REACH) & (np.abs(along_b) <= REACH) & (u**2 + v**2 <= MAX_RADIUS_PX**2)
    inside &= (np.abs(along_a) * height_a[:, None] <= near[:, None]) | (
        np.abs(along_b) * height_b[:, None] <= near[:, None]
    )
    column, row = du + centre[:, :1], dv + centre[:, 1:]
    inside &= (column >= 0) & (column < width) & (row >= 0) & (row < height)
    most = max(int(inside.sum(axis=1).max(initial=1)), 1)
    order = np.argsort(~inside, axis=1, kind="stable")[:, :most]
    weight = np.take_along_axis(inside, order, axis=1).astype(np.float64)
    column = np.clip(np.take_along_axis(column, order, axis=1), 0, width - 1).astype(np.int64)
    row = np.clip(np.take_along_axis(row, order, axis=1), 0, height - 1).astype(np.int64)
    value = image[row, column].astype(np.float64)
    return _Window(centre, column - centre[:, :1], row - centre[:, 1:], value, weight, np.maximum(radius, 2.0))


def _brightness(values: FloatArray, window: _Window, start: EdgeStart) -> None:
    """Set a and b of `values` by linear least squares with everything else as it stands."""
    values[:, B] = start.sign
    values[:, A] = 0.0
    pattern = _model(values, window, start.curvature, start.gaps)[0]
    total = np.maximum(window.weight.sum(axis=1), 1.0)
    mean_p = (window.weight * pattern).sum(axis=1) / total
    mean_i = (window.weight * window.value).sum(axis=1) / total
    spread = pattern - mean_p[:, None]
    slope = (window.weight * spread * window.value).sum(axis=1) / np.maximum(
        (window.weight * spread**2).sum(axis=1), 1e-9
    )
    values[:, B] = slope * start.sign
    values[:, A] = mean_i - slope * mean_p


def _step(distance: FloatArray, blur: FloatArray, gaps: FloatArray) -> tuple[FloatArray, ...]:
    """Return the blurred step S over the line, S' and S'' (with respect to distance / s), and u S' summed for dS/ds.

    S is F at the line itself less F at the parallel neighbouring lines `gaps` (N, 2) before and after it: where squares
    are small against the blur their edges reach into the window.
    """
    wide = STEP_WIDTH * blur[:, None]
    total = _smooth_step(distance / wide)
    if (gaps < 2.0 * STEP_WIDTH * blur[:, None]).any():
        for place in (-gaps[:, :1], gaps[:, 1:]):
            other = _smooth_step((distance - place) / wide)
            total = tuple(mine - theirs for mine, theirs in zip(total, other, strict=True))
            # Far from both lines the neighbours' steps add up to a constant of 0: one is -1, the other +1.
    return total


def _smooth_step(u: FloatArray) -> tuple[FloatArray, ...]:
    """Return F, dF/dx, d2F/dx2 and x dF/dx at x = 3 u."""
    u = np.clip(u, -1.0, 1.0)
    square = u * u
    rest = 1.0 - square
    value = u * (35.0 - square * (35.0 - square * (21.0 - 5.0 * square))) / 16.0
    rest2 = rest * rest
    slope = (35.0 / 16.0 / STEP_WIDTH) * rest2 * rest
    bend = (-105.0 / 8.0 / STEP_WIDTH**2) * u * rest2
    return value, slope, bend, STEP_WIDTH * u * slope


def _model(
    values: FloatArray, window: _Window, curvature: FloatArray, gaps: FloatArray
) -> tuple[FloatArray, tuple[FloatArray, ...]]:
    """Return the modelled brightness (N, P) and what its derivatives need.

    The blur mixes the two steps where the lines cross aslant: for a Gaussian, E[sign d1 sign d2] is the sum over k of
    rho^k / k! S1^(k) S2^(k) (Mehler) with rho the cosine between the lines; two terms are kept.
    """
    qu, qv = window.u - values[:, X, None], window.v - values[:, Y, None]
    parts: list[FloatArray] = []
    for angle, line in ((T1, 0), (T2, 1)):
        cosine, sine = np.cos(values[:, angle, None]), np.sin(values[:, angle, None])
        along, aside = cosine * qu + sine * qv, cosine * qv - sine * qu
        kappa = curvature[:, line, None]
        parts += [*_step(aside - 0.5 * kappa * along**2, values[:, S], gaps[:, line])]
        parts += [along, aside, cosine, sine, kappa]
    light = 1.0 + (values[:, GX, None] * window.u + values[:, GY, None] * window.v) / window.size[:, None]
    rho = np.cos(values[:, T1] - values[:, T2])[:, None]
    # Brightness grows with the angle across line 1 where the sign is +: that is d1 > 0, d2 < 0 bright.
    pattern = -(parts[0] * parts[9] + rho * parts[1] * parts[10] + (0.5 * rho**2) * parts[2] * parts[11])
    plain = values[:, A, None] + values[:, B, None] * pattern
    return light * plain, (*parts, rho, light, pattern, plain)


def _linearise(
    values: FloatArray, window: _Window, curvature: FloatArray, gaps: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return the Jacobian (N, 9, P) and the residuals (N, P), both zero in the padding."""
    model, parts = _model(values, window, curvature, gaps)
    f1, slope1, bow1, grown1, along1, aside1, cos1, sin1, kappa1 = parts[:9]
    f2, slope2, bow2, grown2, along2, aside2, cos2, sin2, kappa2 = parts[9:18]
    rho, light, pattern, plain = parts[18:]
    weight = window.weight
    scale = -(values[:, B] / values[:, S])[:, None] * light * weight
    by_d1, by_d2 = scale * (slope1 * f2 + rho * bow1 * slope2), scale * (slope2 * f1 + rho * bow2 * slope1)
    bend1, bend2 = kappa1 * along1, kappa2 * along2
    jacobian = np.empty((len(values), PARAMETERS, weight.shape[1]))
    jacobian[:, X] = by_d1 * (sin1 + bend1 * cos1) + by_d2 * (sin2 + bend2 * cos2)
    jacobian[:, Y] = by_d1 * (bend1 * sin1 - cos1) + by_d2 * (bend2 * sin2 - cos2)
    jacobian[:, T1] = -by_d1 * (along1 + bend1 * aside1)
    jacobian[:, T2] = -by_d2 * (along2 + bend2 * aside2)
    jacobian[:, S] = -scale * (grown1 * f2 + grown2 * f1)
    jacobian[:, A] = light * weight
    jacobian[:, B] = jacobian[:, A] * pattern
    shaded = plain * weight / window.size[:, None]
    jacobian[:, GX] = shaded * window.u
    jacobian[:, GY] = shaded * window.v
    return jacobian, (window.value - model) * weight


def _limited(step: FloatArray, values: FloatArray) -> FloatArray:
    """Return the step, cut where it would leave the region in which the model is nearly linear."""
    limit = np.full(step.shape, np.inf)
    limit[:, [X, Y]] = 1.0
    limit[:, [T1, T2]] = 0.2
    limit[:, S] = 0.3 * values[:, S]
    limit[:, [GX, GY]] = 0.3
    out = np.clip(step, -limit, limit)
    out[:, S] = np.clip(values[:, S] + out[:, S], *BLUR_RANGE) - values[:, S]
    return out


def _surrounded(pixels: FloatArray, window: _Window) -> BoolArray:
    """Return whether there are pixels on all sides of the corner: it is not cut off by the frame."""
    u = window.u + (window.centre - pixels)[:, :1]
    v = window.v + (window.centre - pixels)[:, 1:]
    there = window.weight > 0.0
    sides = [there & (part > 0.5) for part in (u, -u, v, -v)]
    surrounded: BoolArray = np.all([side.sum(axis=1) >= 2 for side in sides], axis=0)
    return surrounded


def _result(values: FloatArray, variance: FloatArray, normal: FloatArray, window: _Window, start: EdgeStart) -> EdgeFit:
    covariance = np.linalg.inv(normal) * variance[:, None, None]
    pixels = window.centre + values[:, [X, Y]]
    spread = 0.5 * (covariance[:, X, X] + covariance[:, Y, Y])
    used = window.weight.sum(axis=1).astype(np.int64)
    moved = np.linalg.norm(pixels - start.pixels, axis=1)
    longest = np.linalg.norm(start.sides, axis=2).max(axis=1)
    valid = (moved < np.maximum(1.5, 0.2 * longest)) & (spread > 0.0) & np.isfinite(spread)
    valid &= (used > PARAMETERS) & _surrounded(pixels, window)
    return EdgeFit(
        pixels,
        np.sqrt(np.maximum(spread, 0.0)),
        values[:, [T1, T2]],
        values[:, S],
        2.0 * values[:, B] * start.sign,
        np.sqrt(variance),
        used,
        valid,
    )
