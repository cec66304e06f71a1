"""How the rows and columns of a lattice bend at its corners.

The edge model is told the curvature of its two lines: an error of 1e-4 / px moves a corner by some thousandths of a
pixel. A row is a smooth curve of the column number; its Taylor coefficients at a corner are the most probable ones
given the corners on the row, with their standard deviations, and that the k-th is about DECAY^k sides of the cell, or
phi^(k - 1) / 2 where a line is seen to turn, or its cells to grow, by phi a cell, as large squares do in a fisheye. Few
or noisy corners leave the high ones near zero; many exact ones are followed to the end of the row, where a polynomial
of low degree would miss. Where few corners leave the curvature open, its standard deviation says so.
"""

from __future__ import annotations

import numpy as np

from rigkit.core.arrays import BoolArray, FloatArray
from rigkit.detection.lattice.lattice import LatticeStack
from rigkit.kernels.edges import BendRules, line_bends

__all__ = ["line_curvature"]

DECAY = 0.1
"""Boards under strong perspective and in fisheyes have coefficients up to this^k, in sides of the cell."""

BENT_RAD = 0.06
"""Where this phi is seen, DECAY would be too strict: the third coefficient, phi^2 / 2, then exceeds DECAY^3."""

LINE_REACH = LatticeStack.GAP
"""Corners so many cells away are used: on a sheet, further ones may be another board's."""

COEFFICIENTS = 6
"""Coefficients of order 0 to 5."""

MIN_CORNER_SIGMA_PX = 1e-3
"""No corner is taken to be better than this."""

FREE = 1e-6
"""Weight of the prior on position and direction: none to speak of, but enough for a corner that is alone."""


def line_curvature(
    pixels: FloatArray, sigma_px: FloatArray, cells: BoolArray, sides_px: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return the curvature of row and column at the M `cells` and its standard deviation, (M, 2) each, 1/px.

    Positive towards +90 degrees.

    Parameters
    ----------
    pixels : (R, C, 2), finite at the `cells`.
    sigma_px : (R, C), NaN where the corner is not to be relied on.
    cells : (R, C) bool, row by row.
    sides_px : (M, 2) lengths of the cell's sides along row and column.
    """
    rules = BendRules(DECAY, MIN_CORNER_SIGMA_PX, FREE, BENT_RAD, LINE_REACH)
    compiled = line_bends(pixels, sigma_px, cells, sides_px, rules)
    if compiled is not None:
        return compiled
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


def _most_probable(normal: FloatArray, right: FloatArray, expected: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the coefficients (M, K, 2) that are `expected` (M, K) in size, and the second's sigma (M,)."""
    prior = np.diag([FREE, FREE, *[1.0] * (COEFFICIENTS - 2)])
    inverse = np.linalg.inv(normal * expected[:, :, None] * expected[:, None, :] + prior)
    found = expected[..., None] * (inverse @ (expected[..., None] * right))
    return found, expected[:, 2] * np.sqrt(inverse[:, 2, 2])
