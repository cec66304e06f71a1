"""Derivatives of a map from a board's plane to an image, by differences from five places."""

from __future__ import annotations

import numpy as np

from rigkit.core.arrays import FloatArray

STENCIL = np.array([[0.0, 0.0], [1.0, 0.0], [-1.0, 0.0], [0.0, 1.0], [0.0, -1.0]])
"""The places, in steps: here, then to either side along both axes of the board."""


def by_differences(pixels: FloatArray, step: float) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return where a map shows M places, (M, 2), and its first and second derivatives along both axes, (M, 2, 2) each,
    from the `pixels` (5, M, 2) of places `step` times STENCIL away."""
    here, right, left, below, above = pixels
    sides = np.stack([right - left, below - above], axis=1) / (2.0 * step)
    curvatures = np.stack([right - 2.0 * here + left, below - 2.0 * here + above], axis=1) / step**2
    return here, sides, curvatures
