"""What the kernel of circle_maps.c computes, in numpy."""

from __future__ import annotations

from math import factorial

import numpy as np

from rigkit.core.arrays import BoolArray, FloatArray, IntArray
from rigkit.detection.circles.local_map import (
    MAP_REACH,
    MAP_WIDTH,
    MIN_BELOW,
    MIN_RIDGE,
    NEXT,
    SLIGHT,
    TYPICAL_DERIVATIVES,
    PlaneMap,
    plane_basis,
)

POWERS = tuple((order - k, k) for order in range(len(TYPICAL_DERIVATIVES)) for k in range(order + 1))


def local_maps(
    label: IntArray, pixels: FloatArray, places: IntArray, *, hexagonal: bool, sigma_px: float, leave_out: bool = False
) -> PlaneMap:
    """Return the maps around `places` (M, 2) of a lattice, from its circles at `label` (N, 2) and `pixels` (N, 2).

    `sigma_px`: standard deviation of the circles. `leave_out`: without the circles at the places themselves.
    """
    step = plane_basis(hexagonal)
    side = int(np.ceil(MAP_REACH * 1.2)) + 1
    offset = np.stack(np.meshgrid(np.arange(-side, side + 1), np.arange(-side, side + 1)), axis=-1).reshape(-1, 2)
    plane = offset @ step.T
    near = np.hypot(*plane.T) < MAP_REACH
    offset, plane = offset[near], plane[near]
    low = np.minimum(label.min(axis=0), places.min(axis=0)) - side
    size = np.maximum(label.max(axis=0), places.max(axis=0)) + side + 1 - low
    table = np.full((*size, 2), np.nan)
    table[tuple((label - low).T)] = pixels
    around = table[tuple((places[:, None, :] + offset - low).transpose(2, 0, 1))]
    known: BoolArray = np.isfinite(around[..., 0])
    centre = (offset == 0).all(axis=1)
    if leave_out:
        known = known & ~centre
    x, y = plane.T
    terms = np.stack([x**i * y**j / (factorial(i) * factorial(j)) for i, j in POWERS], axis=1)
    weight = np.where(known, np.exp(-0.5 * (x * x + y * y) / MAP_WIDTH**2), 0.0)
    # Relative to the mean of the neighbours, so that the prior of derivatives does not act on image coordinates.
    middle = np.nansum(np.where(known[..., None], around, 0.0), axis=1) / np.maximum(known.sum(axis=1), 1)[:, None]
    values = np.where(known[..., None], around - middle[:, None], 0.0)
    pitch = np.sqrt(np.nanmean(np.where(known[..., None], values, np.nan) ** 2) / np.mean(x * x + y * y))
    ridge = np.array([(sigma_px / (pitch * TYPICAL_DERIVATIVES[i + j])) ** 2 for i, j in POWERS]) + MIN_RIDGE
    homography, own = _homographies(plane, values, weight)
    rest = np.where(known[..., None], values - homography, 0.0)
    # Many places have the same pattern of neighbours, and with it the same matrix of the normal equations.
    _, first, kind = np.unique(known @ (1 << np.arange(len(offset))), return_index=True, return_inverse=True)
    inverse = np.linalg.inv(_sums(weight[first], terms, terms) + np.diag(ridge))
    solved = inverse[kind] @ np.swapaxes((weight[..., None] * rest).swapaxes(1, 2) @ terms, 1, 2)
    parts = solved + np.pad(own, ((0, 0), (0, len(POWERS) - own.shape[1]), (0, 0)))
    # Weights of each circle in the first three terms, the value and its derivatives.
    gain, *sides = np.linalg.norm(weight[first, None] * (inverse[:, :3] @ terms.T), axis=2)[kind].T
    return PlaneMap(
        pixels=parts[:, 0] + middle,
        first=np.swapaxes(parts[:, 1:3], 1, 2),
        second=np.swapaxes(parts[:, 3:6], 1, 2),
        support=(known & ~centre).sum(axis=1),
        surrounded=(known | centre)[:, np.hypot(x, y) < NEXT].all(axis=1),
        gain=gain,
        slope_gain=np.sqrt(np.mean(np.square(sides), axis=0)),
    )


def _sums(weight: FloatArray, one: FloatArray, other: FloatArray) -> FloatArray:
    """Return the sums (M, I, J) of `weight` (M, K) times products of `one` (K, I) and `other` (K, J)."""
    products = (one[:, :, None] * other[:, None, :]).reshape(len(one), -1)
    return np.asarray((weight @ products).reshape(len(weight), one.shape[1], other.shape[1]))


def _homographies(plane: FloatArray, values: FloatArray, weight: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return M homographies through `values` (M, K, 2) over `plane` (K, 2), at the K places, and their derivatives
    (M, 6, 2) of order 0 to 2 at the origin.

    Polynomials of low degree cannot model a strong slant, but they can model the residuals of the homography.
    """
    count = len(values)
    x, y = plane.T
    # x' (1 + g . w) = c + A w is linear in c, A and g.
    simple = np.stack([np.ones_like(x), x, y], axis=1)
    u, v = weight * values[..., 0], weight * values[..., 1]
    squares = u * values[..., 0] + v * values[..., 1]
    normal, right = np.zeros((count, 8, 8)), np.zeros((count, 8, 1))
    normal[:, 0:3, 0:3] = normal[:, 3:6, 3:6] = _sums(weight, simple, simple)
    normal[:, 0:3, 6:], normal[:, 3:6, 6:] = -_sums(u, simple, plane), -_sums(v, simple, plane)
    normal[:, 6:, 6:] = _sums(squares, plane, plane)
    normal[:, 6:, :6] = np.swapaxes(normal[:, :6, 6:], 1, 2)
    right[:, :, 0] = np.concatenate([u @ simple, v @ simple, -squares @ plane], axis=1)
    scale = np.maximum((weight[..., None] * values**2).mean(axis=(1, 2)), 1e-9)
    pull = np.zeros((count, 8))
    pull[:, :6], pull[:, 6:] = MIN_RIDGE, (scale * SLIGHT)[:, None]
    found = np.linalg.solve(normal + pull[:, :, None] * np.eye(8), right)[..., 0]
    offset, matrix, bend = found[:, [0, 3]], found[:, [1, 2, 4, 5]].reshape(count, 2, 2), found[:, 6:]
    below = 1.0 + bend @ plane.T
    # Near a horizon nothing can be predicted.
    below = np.where(below > MIN_BELOW, below, MIN_BELOW)
    at = (offset[:, None] + np.einsum("mij,kj->mki", matrix, plane)) / below[..., None]
    first = matrix - offset[:, :, None] * bend[:, None, :]
    second = -first[:, :, :, None] * bend[:, None, None, :]
    second = second + np.swapaxes(second, 2, 3)
    parts = [offset, first[..., 0], first[..., 1], second[..., 0, 0], second[..., 0, 1], second[..., 1, 1]]
    return at, np.stack(parts, axis=1)
