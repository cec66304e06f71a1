"""The fit of steps of the light of light.c, in numpy: all corners at once, with the error function itself."""

from __future__ import annotations

import numpy as np
from scipy.special import erf

from rigkit.core.arrays import BoolArray, FloatArray
from rigkit.detection.saddles.response import GreyImage, sample
from rigkit.detection.subpixel.shadows import (
    LIGHT_RANGE,
    LIGHT_RULES,
    MAX_LIGHT_STEP,
    MIN_SHADOW_LATERAL_PX,
    SAMPLED_ALONG,
    SAMPLED_LATERAL,
    UNEVEN_LIGHT,
)
from rigkit.kernels.light import LIGHT_LATERAL

RADIUS_PX, LIGHT_REACH_CELLS, WIDTH_RANGE_PX = (
    LIGHT_RULES.radius_px,
    LIGHT_RULES.reach_cells,
    (LIGHT_RULES.min_width, LIGHT_RULES.max_width),
)

OFFSETS = np.stack(np.meshgrid(*[np.arange(-RADIUS_PX, RADIUS_PX + 1.0)] * 2), axis=-1).reshape(-1, 2)
OFFSETS = OFFSETS[np.hypot(OFFSETS[:, 0], OFFSETS[:, 1]) < RADIUS_PX]

CORNER, LINES, BLUR, LEVEL, CONTRAST, TOWARDS, PLACE, WIDTH, LEFT, UNKNOWNS = (
    *(slice(0, 2), slice(2, 4), 4, 5, 6, 7, 8, 9, 10, 11),
)

ON_EDGE = 1e-9
"""Pixels so little beyond an edge, px, are on it."""


def beside_shadows(
    image: GreyImage, pixels: FloatArray, sides: FloatArray, lateral: FloatArray, ends: BoolArray
) -> BoolArray:
    """Return what `shadows.beside_shadows` does."""
    lengths = np.maximum(np.hypot(sides[..., 0], sides[..., 1]), 1e-9)
    off = np.minimum(SAMPLED_LATERAL, lateral[:, None] / lengths)
    seen = (off * lengths).min(axis=1) > MIN_SHADOW_LATERAL_PX
    lines = np.eye(2)[:, None, :]
    cells = (
        np.reshape(SAMPLED_ALONG, (-1, 1, 1, 1)) * lines
        + np.array([-1.0, 1.0])[:, None] * lines[::-1] * off[:, None, None, None, :]
    )
    # What is mirrored at the corner has the same colour.
    places = pixels[:, None, None, None, None] + np.stack([cells, -cells], axis=4) @ sides[:, None, None, None]
    last = np.array(image.shape[::-1]) - 1.0
    inside: BoolArray = np.asarray(((places >= 0.0) & (places <= last)).all(axis=(2, 3, 4, 5)))
    seen &= inside[:, 0] & (inside[:, 1] | ends)
    values = sample(image, places)
    contrast: FloatArray = np.abs(values[:, :, :, 1] - values[:, :, :, 0]).max(axis=(2, 3))
    apart = np.abs(values[..., 1] - values[..., 0]).max(axis=(2, 3))
    uneven: BoolArray = np.asarray(apart > UNEVEN_LIGHT * contrast)
    uneven[ends, 1:] = False
    return np.asarray(seen & uneven.any(axis=1))


def light_steps(
    image: GreyImage, start: FloatArray, sides: FloatArray, curvature: FloatArray, blur: float, lateral: FloatArray
) -> tuple[FloatArray, BoolArray]:
    """Return u, v, sigma, direction, place, width, light left (N, 7) of `shadows.light_steps`, and which were found."""
    first = np.rint(start)
    angles = np.arctan2(sides[..., 1], sides[..., 0])
    rest = OFFSETS + (first - start)[:, None]
    cells = np.einsum("nji,npj->npi", np.linalg.inv(sides), rest)
    across = rest[..., 1:] * np.cos(angles)[:, None] - rest[..., :1] * np.sin(angles)[:, None]
    inside = np.abs(cells) < LIGHT_REACH_CELLS
    at = first[:, None] + OFFSETS
    seen = ((at >= 0.0) & (at <= np.array(image.shape[::-1]) - 1.0)).all(axis=2)
    used = seen & inside.all(axis=2) & (np.abs(across) < lateral[:, None, None]).any(axis=2)
    column, row = np.moveaxis(at.clip(0.0, np.array(image.shape[::-1]) - 1.0).astype(np.int64), 2, 0)
    values, weight = image[row, column].astype(np.float64), used.astype(np.float64)
    pattern = edge_at(across[..., 0] / blur)[0] * edge_at(across[..., 1] / blur)[0]
    unknowns = np.zeros((len(start), UNKNOWNS))
    unknowns[:, CORNER], unknowns[:, LINES] = start - first, angles
    unknowns[:, BLUR], unknowns[:, WIDTH] = np.log(blur), np.log(LIGHT_RULES.first_width)
    unknowns[:, [TOWARDS, PLACE, LEVEL, CONTRAST, LEFT]], found = hard_steps(values, pattern, weight)
    solved, sigma_px = together(values, weight, unknowns, curvature)
    left = solved[:, LEFT]
    out = [first + solved[:, CORNER], sigma_px, solved[:, TOWARDS], solved[:, PLACE], np.exp(solved[:, WIDTH]), left]
    return np.column_stack(out), found & (left > LIGHT_RANGE[0]) & (left < LIGHT_RANGE[1])


def edge_at(z: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return erf(z / sqrt 2) and its derivative."""
    return np.asarray(erf(z / np.sqrt(2.0))), np.sqrt(2.0 / np.pi) * np.exp(-0.5 * z * z)


def hard_steps(values: FloatArray, pattern: FloatArray, weight: FloatArray) -> tuple[FloatArray, BoolArray]:
    """Return direction, place, level, contrast and light left (N, 5) of the sharp steps that explain the windows best.

    For each direction the two sides are fitted apart, with sums over strips between one place and the next.
    """
    count, places = len(values), np.arange(-LIGHT_LATERAL, LIGHT_LATERAL + 1.0)
    products = [weight * part for part in (1.0 + 0.0 * pattern, pattern, pattern**2)]
    products += [products[0] * values, products[1] * values, products[0] * values**2]
    out, best = np.zeros((count, 5)), np.full(count, np.inf)
    mine, strips = np.arange(count), len(places) + 1
    for angle in np.arange(LIGHT_RULES.angles) * (2.0 * np.pi / LIGHT_RULES.angles):
        strip = np.ceil(OFFSETS @ (np.cos(angle), np.sin(angle)) - places[0] - ON_EDGE).clip(0, strips - 1).astype(int)
        of = np.zeros((len(strip), strips))
        of[np.arange(len(strip)), strip] = 1.0
        sums = np.cumsum([product @ of for product in products], axis=2)
        lit, dark = sums[:, :, :-1], sums[:, :, -1:] - sums[:, :, :-1]
        (level, contrast, rest), (level_2, contrast_2, rest_2) = levels(lit), levels(dark)
        left = (level * level_2 + contrast * contrast_2) / np.maximum(level**2 + contrast**2, 1e-9)
        usable = (
            (left > LIGHT_RANGE[0]) & (left < LIGHT_RANGE[1]) & (np.minimum(lit[0], dark[0]) > LIGHT_RULES.min_pixels)
        )
        total = np.where(usable, rest + rest_2, np.inf)
        at = total.argmin(axis=1)
        better = total[mine, at] < best
        best = np.where(better, total[mine, at], best)
        projected = np.stack(
            [np.full(count, angle), places[at], *(part[mine, at] for part in (level, contrast, left))], axis=1
        )
        out[better] = projected[better]
    return out, np.isfinite(best)


def levels(sums: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return level, contrast and the squares left, of values = level + contrast * pattern, from sums of products."""
    one, e, ee, i, ie, ii = sums
    det = one * ee - e * e
    det = np.where(det > 1e-6, det, np.inf)
    level, contrast = (ee * i - e * ie) / det, (one * ie - e * i) / det
    return level, contrast, np.where(np.isfinite(det), ii - level * i - contrast * ie, np.inf)


def together(
    values: FloatArray, weight: FloatArray, start: FloatArray, curvature: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return the unknowns (N, 11) of corner and step, and the corners' standard deviation (N,)."""
    known = np.zeros(UNKNOWNS)
    known[LINES], known[BLUR], known[WIDTH] = (
        LIGHT_RULES.line_sigma**-2,
        LIGHT_RULES.log_edge_sigma**-2,
        LIGHT_RULES.log_width_sigma**-2,
    )
    count = np.maximum(weight.sum(axis=1), 2.0 * UNKNOWNS)
    one, damping, now = np.eye(UNKNOWNS), np.full(len(start), 1e-3), start

    def seen(unknowns: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        model, jacobian = picture(unknowns, curvature)
        rest = (values - model) * weight
        return jacobian * weight[:, None], rest, (rest**2).sum(axis=1)

    def normal(jacobian: FloatArray, cost: FloatArray) -> tuple[FloatArray, FloatArray]:
        variance = np.maximum(cost / (count - UNKNOWNS), 1.0 / 12.0)
        products = jacobian @ np.swapaxes(jacobian, 1, 2) + variance[:, None, None] * np.diag(known) + 1e-6 * one
        return products, variance

    jacobian, rest, cost = seen(now)
    for _ in range(LIGHT_RULES.iterations):
        products, variance = normal(jacobian, cost)
        right = (jacobian @ rest[..., None])[..., 0] - variance[:, None] * known * (now - start)
        diagonal = damping[:, None, None] * products * one
        step = np.linalg.solve(products + diagonal, right[..., None])[..., 0].clip(-MAX_LIGHT_STEP, MAX_LIGHT_STEP)
        tried = now + step
        tried[:, WIDTH] = tried[:, WIDTH].clip(*np.log(WIDTH_RANGE_PX))
        tried[:, LEFT] = tried[:, LEFT].clip(0.5 * LIGHT_RANGE[0], LIGHT_RULES.max_light)
        fresh = seen(tried)
        better = fresh[2] < cost
        now, cost = np.where(better[:, None], tried, now), np.minimum(fresh[2], cost)
        rest = np.where(better[:, None], fresh[1], rest)
        jacobian = np.where(better[:, None, None], fresh[0], jacobian)
        damping = np.where(better, 0.3 * damping, 5.0 * damping)
    products, variance = normal(jacobian, cost)
    spread = np.diagonal(np.linalg.inv(products), axis1=1, axis2=2)[:, CORNER].mean(axis=1)
    return now, np.sqrt(np.maximum(variance * spread, 0.0))


def picture(unknowns: FloatArray, curvature: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the brightness (N, P) of windows and its derivatives (N, 11, P)."""
    u, v, *_, log_blur, level, contrast, towards, place, log_width, left = unknowns.T[:, :, None]
    across, width = np.exp(log_blur), np.exp(log_width)
    edges, moves = [], []
    for line in (0, 1):
        turned, bend = unknowns[:, 2 + line, None], curvature[:, line, None]
        c, s = np.cos(turned), np.sin(turned)
        along = c * (OFFSETS[:, 0] - u) + s * (OFFSETS[:, 1] - v)
        lateral = c * (OFFSETS[:, 1] - v) - s * (OFFSETS[:, 0] - u)
        distance = lateral - 0.5 * bend * along**2
        edge, slope = edge_at(distance / across)
        edges.append(edge)
        moves.append([slope / across * part for part in (s + bend * along * c, bend * along * s - c)])
        moves[-1] += [slope / across * (-along - bend * along * lateral), -slope * distance / across]
    c, s = np.cos(towards), np.sin(towards)
    beyond = (c * OFFSETS[:, 0] + s * OFFSETS[:, 1] - place) / width
    step, slope = edge_at(beyond)
    lost, dark = (1.0 - left) * 0.5 * slope / width, 0.5 + 0.5 * step
    light, pattern = 1.0 - (1.0 - left) * dark, edges[0] * edges[1]
    surface = level + contrast * pattern
    by = [contrast * light * (m0 * edges[1]) for m0 in moves[0]]
    others = [contrast * light * (m1 * edges[0]) for m1 in moves[1]]
    jacobian = np.stack(
        [
            *(by[0] + others[0], by[1] + others[1], by[2], others[2], by[3] + others[3], light, pattern * light),
            -surface * lost * (c * OFFSETS[:, 1] - s * OFFSETS[:, 0]),
            *(surface * lost, surface * lost * beyond * width, surface * dark),
        ],
        axis=1,
    )
    return surface * light, jacobian
