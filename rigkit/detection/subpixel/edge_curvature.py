"""How the rows and columns of a lattice bend at its corners.

The edge model is told the curvature of its two lines: an error of 1e-4 / px moves a corner by some thousandths of a
pixel. A row is a smooth curve of the column number; its Taylor coefficients at a corner are the most probable ones
given the corners on the row, with their standard deviations, and that the k-th is about DECAY^k sides of the cell, or
phi^(k - 1) / 2 where a line is seen to turn, or its cells to grow, by phi a cell, as large squares do in a fisheye. Few
or noisy corners leave the high ones near zero; many exact ones are followed to the end of the row, where a polynomial
of low degree would miss. Where few corners leave the curvature open, its standard deviation says so.
"""

from __future__ import annotations

from rigkit.core.arrays import BoolArray, FloatArray
from rigkit.detection.lattice.lattice import LatticeStack
from rigkit.kernels.edges import BendRules, line_bends

DECAY = 0.1
"""Boards under strong perspective and in fisheyes have coefficients up to this^k, in sides of the cell."""

BENT_RAD = 0.06
"""Where this phi is seen, DECAY would be too strict: the third coefficient, phi^2 / 2, then exceeds DECAY^3."""

LINE_REACH = LatticeStack.GAP
"""Corners so many cells away are used: on a sheet, further ones may be another board's."""

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
    return line_bends(pixels, sigma_px, cells, sides_px, rules)
