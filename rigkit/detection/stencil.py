"""Finite differences of a map from a board's plane to an image, with a five-point stencil."""

from __future__ import annotations

import numpy as np

from rigkit.core.arrays import FloatArray

STENCIL = np.array([[0.0, 0.0], [1.0, 0.0], [-1.0, 0.0], [0.0, 1.0], [0.0, -1.0]])
"""The points of the stencil, in steps along the axes of the board."""


def by_differences(pixels: FloatArray, step: float) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the values of a map at M points, (M, 2), and its first and second derivatives along both axes, (M, 2, 2)
    each, from the `pixels` (5, M, 2) at offsets `step` times STENCIL."""
    here, right, left, below, above = pixels
    sides = np.stack([right - left, below - above], axis=1) / (2.0 * step)
    curvatures = np.stack([right - 2.0 * here + left, below - 2.0 * here + above], axis=1) / step**2
    return here, sides, curvatures
