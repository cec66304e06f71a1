"""Corners beside the edge of a shadow: the light is found, taken out of the image, and the corners fitted again.

A shadow is a factor of the light. Across its edge, seen through a window, that goes in one straight step from 1 to what
is left; the edge model, whose light is smooth, takes part of the step for a shift of the corner. What corner and step
are together the window tells (eleven unknowns). The corner found so is still drawn aside by what the model does not
know of the edges, which mirrors itself at the corner in even light, but not here; so the window's pixels are divided by
the light, and the corner is fitted in them as any other.
"""

from __future__ import annotations

from dataclasses import KW_ONLY, dataclass

import numpy as np

from rigkit.core.arrays import BoolArray, FloatArray
from rigkit.detection.saddles.response import FloatImage, GreyImage, sample

RADIUS_PX, LIGHT_REACH_CELLS = 18.0, 0.44
"""Of the window: as that of the edge model."""

SEEN_ALONG, SEEN_ASIDE = (0.15, 0.35), 0.12
"""Where the light on opposite arms is compared: so far along them and aside, in sides of the cell. Beside the end of a
board, where squares may be cut, only the nearer ones are looked at."""

LEAST_ASIDE_PX = 1.0
"""Nearer to a line its blur is seen, and nothing else."""

UNEVEN = 0.4
"""Opposite squares differ by more than this part of the contrast beside the edges of shadows that leave less than two
thirds of the light: REAL images without any had 63 such corners of 10 700, most of them at the ends of boards."""

LIGHT_ANGLES, MOST_ASIDE_PX = 16, 11
"""Directions in which a step is first sought, and how far from the corner, px by px."""

LIGHT_RANGE, LEAST_PIXELS = (0.1, 0.8), 20
"""What a shadow leaves of the light: of less, 8 bits show no squares, and it may be a hand. On either side of its edge
there must be so many pixels to tell it."""

LINE_SIGMA_RAD, LOG_EDGE_SIGMA, LOG_WIDTH_SIGMA, FIRST_WIDTH_PX = 0.05, 0.1, 0.7, 0.8
"""How well lines, blur, and the width of the shadow's edge are known beforehand."""

LIGHT_FIT_STEPS = 8
"""Of Levenberg and Marquardt."""

MOST_LIGHT_STEP = np.array([0.7, 0.7, 0.2, 0.2, 0.3, 1e3, 1e3, 0.3, 1.5, 0.5, 0.3])
"""What one of them changes at most: corner, angles, log blur, levels; direction, place, log width, light."""

WIDTH_RANGE_PX = (0.3, 6.0)

TILE_PX = 24
"""Half the side of the window's picture in even light: what the edge model may look at."""

_OFFSETS = np.stack(np.meshgrid(*[np.arange(-RADIUS_PX, RADIUS_PX + 1.0)] * 2), axis=-1).reshape(-1, 2)
_OFFSETS = _OFFSETS[np.hypot(_OFFSETS[:, 0], _OFFSETS[:, 1]) < RADIUS_PX]

_CORNER, _LINES, _BLUR, _LEVEL, _CONTRAST, _TOWARDS, _PLACE, _WIDTH, _LEFT = (
    slice(0, 2),
    slice(2, 4),
    4,
    5,
    6,
    7,
    8,
    9,
    10,
)
_UNKNOWNS = 11


@dataclass(frozen=True, eq=False, slots=True)
class LightSteps:
    """A step of the light in the windows of N corners.

    Attributes
    ----------
    centre : (N, 2) pixels that they are told from.
    towards, place : (N,) direction from light to dark, rad, and how far that way the edge lies, px.
    width : (N,) of the edge, as of a normal distribution, px.
    left : (N,) what is left of the light beyond it.
    pixels, sigma_px : (N, 2), (N,) the corners as found together with it, and how well.
    """

    _: KW_ONLY
    centre: FloatArray
    towards: FloatArray
    place: FloatArray
    width: FloatArray
    left: FloatArray
    pixels: FloatArray
    sigma_px: FloatArray

    def light(self, offsets: FloatArray) -> FloatArray:
        """Return the light (N, ...) at pixels `offsets` (..., 2) from the centres."""
        along = np.stack([np.cos(self.towards), np.sin(self.towards)], axis=1) @ offsets.reshape(-1, 2).T
        dark = 0.5 + 0.5 * _edge((along - self.place[:, None]) / self.width[:, None])[0]
        return (1.0 - (1.0 - self.left[:, None]) * dark).reshape(-1, *offsets.shape[:-1])


def beside_shadows(
    image: GreyImage, pixels: FloatArray, sides: FloatArray, aside: FloatArray, ends: BoolArray
) -> BoolArray:
    """Return which of the corners `pixels` (N, 2) of cells with `sides` (N, 2, 2) are lit unevenly.

    `aside` (N,) : how far from the lines brightness may be read, px, at most; `ends` (N,) : where the board may end.
    """
    lengths = np.maximum(np.linalg.norm(sides, axis=2), 1e-9)
    off = np.minimum(SEEN_ASIDE, aside[:, None] / lengths)
    seen = (off * lengths).min(axis=1) > LEAST_ASIDE_PX
    places = np.empty((len(SEEN_ALONG), len(pixels), 2, 2, 2, 2))
    for k, part in enumerate(SEEN_ALONG):
        for line in (0, 1):
            along, across = part * sides[:, line], off[:, 1 - line, None] * sides[:, 1 - line]
            for half, side in enumerate((-1.0, 1.0)):
                # What is mirrored at the corner has the same colour.
                places[k, :, line, half, 0] = pixels + along + side * across
                places[k, :, line, half, 1] = pixels - along - side * across
    seen &= ((places >= 0.0) & (places <= np.array(image.shape[::-1]) - 1.0)).all(axis=(0, 2, 3, 4, 5))
    values = sample(image, places)
    contrast = np.abs(values[:, :, :, 1] - values[:, :, :, 0]).max(axis=(2, 3))
    apart = np.abs(values[..., 1] - values[..., 0]).max(axis=(2, 3))
    uneven = apart > UNEVEN * contrast
    uneven[1:, ends] = False
    return np.asarray(seen & uneven.any(axis=0))


def light_steps(
    image: GreyImage, start: FloatArray, sides: FloatArray, curvature: FloatArray, blur: float, aside: FloatArray
) -> tuple[LightSteps, BoolArray]:
    """Return the steps of the light in the windows of corners near `start` (N, 2), and which were found.

    `sides` (N, 2, 2) and `curvature` (N, 2) of the lines as in `Geometry`, `blur` about that of their edges, px; pixels
    further than `aside` (N,) px from both lines are not used.
    """
    first = np.rint(start)
    angles = np.arctan2(sides[..., 1], sides[..., 0])
    rest = _OFFSETS + (first - start)[:, None]
    cells = np.einsum("nji,npj->npi", np.linalg.inv(sides), rest)
    across = rest[..., 1:] * np.cos(angles)[:, None] - rest[..., :1] * np.sin(angles)[:, None]
    inside = np.abs(cells) < LIGHT_REACH_CELLS
    at = first[:, None] + _OFFSETS
    seen = ((at >= 0.0) & (at <= np.array(image.shape[::-1]) - 1.0)).all(axis=2)
    used = seen & inside.all(axis=2) & (np.abs(across) < aside[:, None, None]).any(axis=2)
    column, row = np.moveaxis(at.clip(0.0, np.array(image.shape[::-1]) - 1.0).astype(np.int64), 2, 0)
    values, weight = image[row, column].astype(np.float64), used.astype(np.float64)
    pattern = _edge(across[..., 0] / blur)[0] * _edge(across[..., 1] / blur)[0]
    unknowns = np.zeros((len(start), _UNKNOWNS))
    unknowns[:, _CORNER], unknowns[:, _LINES] = start - first, angles
    unknowns[:, _BLUR], unknowns[:, _WIDTH] = np.log(blur), np.log(FIRST_WIDTH_PX)
    unknowns[:, [_TOWARDS, _PLACE, _LEVEL, _CONTRAST, _LEFT]], found = _hard_steps(values, pattern, weight)
    solved, sigma_px = _together(values, weight, unknowns, curvature)
    step = LightSteps(
        centre=first,
        towards=solved[:, _TOWARDS],
        place=solved[:, _PLACE],
        width=np.exp(solved[:, _WIDTH]),
        left=solved[:, _LEFT],
        pixels=first + solved[:, _CORNER],
        sigma_px=sigma_px,
    )
    return step, found & (step.left > LIGHT_RANGE[0]) & (step.left < LIGHT_RANGE[1])


def in_even_light(image: GreyImage, steps: LightSteps) -> tuple[FloatImage, FloatArray]:
    """Return the windows in even light, side by side, and what moves pixels of the image to theirs (N, 2)."""
    span = np.arange(-TILE_PX, TILE_PX + 1.0)
    offsets = np.stack(np.meshgrid(span, span), axis=-1)
    at = (steps.centre[:, None, None] + offsets).clip(0.0, np.array(image.shape[::-1]) - 1.0).astype(np.int64)
    lit = image[at[..., 1], at[..., 0]] / steps.light(offsets).clip(LIGHT_RANGE[0])
    picture = np.ascontiguousarray(np.concatenate(list(lit), axis=1), np.float32)
    middle = TILE_PX + np.stack([np.arange(len(lit)) * len(span), np.zeros(len(lit))], axis=1)
    return picture, np.asarray(middle - steps.centre, dtype=np.float64)


def _edge(z: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return erf(z / sqrt 2), good to 3e-4, and its derivative."""
    scale = np.sqrt(2.0 / np.pi)
    value = np.tanh(scale * z * (1.0 + 0.044715 * z * z))
    return value, scale * (1.0 + 0.134145 * z * z) * (1.0 - value * value)


def _hard_steps(values: FloatArray, pattern: FloatArray, weight: FloatArray) -> tuple[FloatArray, BoolArray]:
    """Return direction, place, level, contrast and light left (N, 5) of the sharp steps that explain the windows best.

    For each direction the two sides are fitted apart, with sums over strips between one place and the next.
    """
    count, places = len(values), np.arange(-MOST_ASIDE_PX, MOST_ASIDE_PX + 1.0)
    products = [weight * part for part in (1.0 + 0.0 * pattern, pattern, pattern**2)]
    products += [products[0] * values, products[1] * values, products[0] * values**2]
    out, best = np.zeros((count, 5)), np.full(count, np.inf)
    mine, strips = np.arange(count), len(places) + 1
    for angle in np.arange(LIGHT_ANGLES) * (2.0 * np.pi / LIGHT_ANGLES):
        strip = np.ceil(_OFFSETS @ (np.cos(angle), np.sin(angle)) - places[0]).clip(0, strips - 1).astype(np.int64)
        of = np.zeros((len(strip), strips))
        of[np.arange(len(strip)), strip] = 1.0
        sums = np.cumsum([product @ of for product in products], axis=2)
        lit, dark = sums[:, :, :-1], sums[:, :, -1:] - sums[:, :, :-1]
        (level, contrast, rest), (level_2, contrast_2, rest_2) = _levels(lit), _levels(dark)
        left = (level * level_2 + contrast * contrast_2) / np.maximum(level**2 + contrast**2, 1e-9)
        usable = (left > LIGHT_RANGE[0]) & (left < LIGHT_RANGE[1]) & (np.minimum(lit[0], dark[0]) > LEAST_PIXELS)
        total = np.where(usable, rest + rest_2, np.inf)
        at = total.argmin(axis=1)
        better = total[mine, at] < best
        best = np.where(better, total[mine, at], best)
        told = np.stack(
            [np.full(count, angle), places[at], *(part[mine, at] for part in (level, contrast, left))], axis=1
        )
        out[better] = told[better]
    return out, np.isfinite(best)


def _levels(sums: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return level, contrast and the squares left, of values = level + contrast * pattern, from sums of products."""
    one, e, ee, i, ie, ii = sums
    det = one * ee - e * e
    det = np.where(det > 1e-6, det, np.inf)
    level, contrast = (ee * i - e * ie) / det, (one * ie - e * i) / det
    return level, contrast, np.where(np.isfinite(det), ii - level * i - contrast * ie, np.inf)


def _together(
    values: FloatArray, weight: FloatArray, start: FloatArray, curvature: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return the unknowns (N, 11) of corner and step, and the corners' standard deviation (N,)."""
    known = np.zeros(_UNKNOWNS)
    known[_LINES], known[_BLUR], known[_WIDTH] = LINE_SIGMA_RAD**-2, LOG_EDGE_SIGMA**-2, LOG_WIDTH_SIGMA**-2
    count = np.maximum(weight.sum(axis=1), 2.0 * _UNKNOWNS)
    one, damping, now = np.eye(_UNKNOWNS), np.full(len(start), 1e-3), start

    def seen(unknowns: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        model, jacobian = _picture(unknowns, curvature)
        rest = (values - model) * weight
        return jacobian * weight[:, None], rest, (rest**2).sum(axis=1)

    def normal(jacobian: FloatArray, cost: FloatArray) -> tuple[FloatArray, FloatArray]:
        variance = np.maximum(cost / (count - _UNKNOWNS), 1.0 / 12.0)
        products = jacobian @ np.swapaxes(jacobian, 1, 2) + variance[:, None, None] * np.diag(known) + 1e-6 * one
        return products, variance

    jacobian, rest, cost = seen(now)
    for _ in range(LIGHT_FIT_STEPS):
        products, variance = normal(jacobian, cost)
        right = (jacobian @ rest[..., None])[..., 0] - variance[:, None] * known * (now - start)
        diagonal = damping[:, None, None] * products * one
        step = np.linalg.solve(products + diagonal, right[..., None])[..., 0].clip(-MOST_LIGHT_STEP, MOST_LIGHT_STEP)
        tried = now + step
        tried[:, _WIDTH] = tried[:, _WIDTH].clip(*np.log(WIDTH_RANGE_PX))
        tried[:, _LEFT] = tried[:, _LEFT].clip(0.5 * LIGHT_RANGE[0], 1.5)
        fresh = seen(tried)
        better = fresh[2] < cost
        now, cost = np.where(better[:, None], tried, now), np.minimum(fresh[2], cost)
        rest = np.where(better[:, None], fresh[1], rest)
        jacobian = np.where(better[:, None, None], fresh[0], jacobian)
        damping = np.where(better, 0.3 * damping, 5.0 * damping)
    products, variance = normal(jacobian, cost)
    spread = np.diagonal(np.linalg.inv(products), axis1=1, axis2=2)[:, _CORNER].mean(axis=1)
    return now, np.sqrt(np.maximum(variance * spread, 0.0))


def _picture(unknowns: FloatArray, curvature: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the brightness (N, P) of windows and its derivatives (N, 11, P)."""
    u, v, *_, log_blur, level, contrast, towards, place, log_width, left = unknowns.T[:, :, None]
    across, width = np.exp(log_blur), np.exp(log_width)
    edges, moves = [], []
    for line in (0, 1):
        turned, bend = unknowns[:, 2 + line, None], curvature[:, line, None]
        c, s = np.cos(turned), np.sin(turned)
        along = c * (_OFFSETS[:, 0] - u) + s * (_OFFSETS[:, 1] - v)
        aside = c * (_OFFSETS[:, 1] - v) - s * (_OFFSETS[:, 0] - u)
        distance = aside - 0.5 * bend * along**2
        edge, slope = _edge(distance / across)
        edges.append(edge)
        moves.append([slope / across * part for part in (s + bend * along * c, bend * along * s - c)])
        moves[-1] += [slope / across * (-along - bend * along * aside), -slope * distance / across]
    c, s = np.cos(towards), np.sin(towards)
    beyond = (c * _OFFSETS[:, 0] + s * _OFFSETS[:, 1] - place) / width
    step, slope = _edge(beyond)
    lost, dark = (1.0 - left) * 0.5 * slope / width, 0.5 + 0.5 * step
    light, pattern = 1.0 - (1.0 - left) * dark, edges[0] * edges[1]
    surface = level + contrast * pattern
    by = [contrast * light * (m0 * edges[1]) for m0 in moves[0]]
    others = [contrast * light * (m1 * edges[0]) for m1 in moves[1]]
    jacobian = np.stack(
        [
            *(by[0] + others[0], by[1] + others[1], by[2], others[2], by[3] + others[3], light, pattern * light),
            -surface * lost * (c * _OFFSETS[:, 1] - s * _OFFSETS[:, 0]),
            *(surface * lost, surface * lost * beyond * width, surface * dark),
        ],
        axis=1,
    )
    return surface * light, jacobian
