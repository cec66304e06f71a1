"""How the rows and columns of a lattice bend at its corners.

The edge model is told the curvature of its two lines: an error of 1e-4 / px moves a corner by some thousandths of a
pixel. A row is a smooth curve of the column number. Its Taylor coefficients at a corner are the most probable ones
given the corners on the row with their standard deviations, and a prior: the k-th is about DECAY^k sides of the cell.
Where a line is seen to turn, or its cells to grow, by phi a cell, as large squares do in a fisheye, it is about
phi^(k - 1) / 2. Few or noisy corners leave the high ones near zero; many exact ones are followed to the end of the row,
where a polynomial of low degree would miss. Where few corners leave the curvature open, its standard deviation says so.
"""

from __future__ import annotations

import numpy as np

from rigkit.core.arrays import BoolArray, FloatArray
from rigkit.detection.lattice.lattice import LatticeStack
from rigkit.detection.subpixel.edge_model import WINDOW_REACH
from rigkit.kernels.edges import CurvatureRules, line_curvatures

DECAY = 0.1
"""Boards under strong perspective and in fisheyes have coefficients up to this^k, in sides of the cell."""

CURVED_RAD = 0.06
"""Where this phi is seen, DECAY would be too strict: the third coefficient, phi^2 / 2, then exceeds DECAY^3."""

LINE_REACH = LatticeStack.GAP
"""Corners so many cells away are used: on a sheet, further ones may be another board's."""

MIN_CORNER_SIGMA_PX = 1e-3
"""No corner is taken to be better than this."""

LOOSE_CURVATURE = 0.5
"""Curvatures are fitted where the lattice leaves them open by so much that the corner would move by more than this, in
sigmas of the fit before: the edges then know them better. Everywhere it would take a quarter more time."""

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
    rules = CurvatureRules(DECAY, MIN_CORNER_SIGMA_PX, FREE, CURVED_RAD, LINE_REACH)
    return line_curvatures(pixels, sigma_px, cells, sides_px, rules)


def line_curvatures_to_fit(
    pixels: FloatArray, sigma_px: FloatArray, cells: BoolArray, sides: FloatArray, radius_px: float
) -> tuple[FloatArray, FloatArray]:
    """Return the curvature as `line_curvature` does, with a standard deviation of 0 where it is known well enough for a
    fit in windows of `radius_px` to keep it. `sides` (M, 2, 2) are those of the cells, px."""
    lengths = np.maximum(np.hypot(sides[..., 0], sides[..., 1]), 1.0)
    curvature, curvature_sigma = line_curvature(pixels, sigma_px, cells, lengths)
    # A parabola k / 2 t^2 lies k / 6 r^2 beside the corner in the mean over |t| < r.
    beside = curvature_sigma * np.minimum(radius_px, WINDOW_REACH * lengths) ** 2 / 6.0
    curvature_sigma[(beside <= LOOSE_CURVATURE * sigma_px[cells][:, None]).all(axis=1)] = 0.0
    return curvature, curvature_sigma
