"""Calls of the kernels in five_point.c and six_point.c: essential matrices of unit norm from many minimal samples.

Five equations (five points, or one affine correspondence and two points): ten cubics in three unknowns, solved by a
polynomial in one of them (Nister, "An efficient solution to the five-point relative pose problem", 2004). Six (two
affine correspondences): ten cubics in two unknowns, linear in their ten monomials (Eichhardt and Barath; Raposo and
Barreto).
"""

from __future__ import annotations

import numpy as np

from rigkit.core.arrays import FloatArray, Mat3
from rigkit.kernels import kernels
from rigkit.kernels.declarations import header

MAX_ROOTS = header().constants["MAX_ROOTS"]


def five_rows(rows: FloatArray) -> Mat3:
    """Return up to ten E (B, 10, 3, 3) of `rows` (B, 5, 9), NaN where there are fewer."""
    out = np.empty((len(rows), MAX_ROOTS, 3, 3))
    kernels().five_rows(rows, len(rows), out)
    return out


def six_rows(rows: FloatArray) -> Mat3:
    """Return the E (B, 1, 3, 3) of `rows` (B, 6, 9): nearest to the matrix whose monomials violate the ten cubics
    least.

    The monomials are scaled so that the answer does not depend on the choice of the basis: all 27 products of three of
    the unknowns, of which ten differ, have the length one together.
    """
    out = np.empty((len(rows), 1, 3, 3))
    kernels().six_rows(rows, len(rows), out)
    return out
