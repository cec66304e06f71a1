"""Curvature of the rows and columns of a lattice at its corners.

The edge model needs the curvature of its two lines: an error of 1e-4 / px shifts a corner by some thousandths of a
pixel. A row is a smooth function of the column number. Its Taylor coefficients at a corner are maximum a posteriori
estimates from the corners of the row, with a prior standard deviation of the k-th coefficient of DECAY^k sides of the
cell. If a line turns, or its cells grow, by phi per cell, as for large squares in a fisheye, it is phi^(k - 1) / 2.
With few or noisy corners the high coefficients remain near zero; many accurate ones are followed to the end of the row.
The standard deviation of the curvature is estimated too.
"""

from __future__ import annotations

import numpy as np

from rigkit.core.arrays import BoolArray, FloatArray
from rigkit.detection.lattice.lattice import LatticeStack
from rigkit.detection.subpixel.edge_model import WINDOW_REACH
from rigkit.kernels.edges import CurvatureRules, line_curvatures

DECAY = 0.1
"""The k-th coefficient of boards under strong perspective and in fisheyes is at most this^k, in sides of the cell."""

CURVED_RAD = 0.06
"""Smallest phi for which DECAY is too strict: the third coefficient, phi^2 / 2, then exceeds DECAY^3."""

LINE_REACH = LatticeStack.GAP
"""Largest distance, in cells, of the corners used; in a stack of lattices further ones may belong to another board."""

MIN_CORNER_SIGMA_PX = 1e-3
"""Lower bound of the corners' standard deviations."""

LOOSE_CURVATURE = 0.5
"""The edge model fits a curvature if its uncertainty may shift the corner by more than this, in sigmas of the previous
fit. Fitting all curvatures would take a quarter more time."""

FREE = 1e-6
"""Weight of the prior on unknowns without any other, which keeps the normal equations solvable."""


def line_curvature(
    pixels: FloatArray, sigma_px: FloatArray, cells: BoolArray, sides_px: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return the curvature of row and column at the M `cells` and its standard deviation, (M, 2) each, 1/px.

    Positive towards +90 degrees.

    Parameters
    ----------
    pixels : (R, C, 2), finite at the `cells`.
    sigma_px : (R, C), NaN for corners that are not used.
    cells : (R, C) bool, row by row.
    sides_px : (M, 2) lengths of the cell's sides along row and column.
    """
    rules = CurvatureRules(DECAY, MIN_CORNER_SIGMA_PX, FREE, CURVED_RAD, LINE_REACH)
    return line_curvatures(pixels, sigma_px, cells, sides_px, rules)


def line_curvatures_to_fit(
    pixels: FloatArray, sigma_px: FloatArray, cells: BoolArray, sides: FloatArray, radius_px: float
) -> tuple[FloatArray, FloatArray]:
    """Return the results of `line_curvature`, with a standard deviation of 0 where a fit in windows of `radius_px` need
    not estimate the curvature. `sides` (M, 2, 2) are those of the cells, px."""
    lengths = np.maximum(np.hypot(sides[..., 0], sides[..., 1]), 1.0)
    curvature, curvature_sigma = line_curvature(pixels, sigma_px, cells, lengths)
    # The mean of a parabola k / 2 t^2 over |t| < r is k / 6 r^2.
    shift = curvature_sigma * np.minimum(radius_px, WINDOW_REACH * lengths) ** 2 / 6.0
    curvature_sigma[(shift <= LOOSE_CURVATURE * sigma_px[cells][:, None]).all(axis=1)] = 0.0
    return curvature, curvature_sigma
