"""Discs painted on a plane: the share of every cell of a sub-sampled image that lies inside of them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from rigkit.core.arrays import FloatArray

Float32 = NDArray[np.float32]

MIN_CELL, MAX_CELL = 1e-6, 2.0
"""A cell's side, in squares or panel sides: shorter is none; longer, the plane is seen edge on and differences mean
nothing."""


def covered_shares(axes: Float32, discs: FloatArray, squares_mm: tuple[float, float]) -> Float32:
    """Return (rows, columns) the share of each cell that `discs` (K, 3), x, y and radius in mm, cover.

    They do not overlap. `axes` : (2, rows, columns) x and y of the cells' middles in squares of `squares_mm`. A cell is
    a parallelogram; to a disc's edge, taken as straight within it, it is the sum of two boxes (see `raycast._Cells`).
    """
    x, y = (axis * np.float32(side) for axis, side in zip(axes, squares_mm, strict=True))
    out = np.zeros(x.shape, np.float32)
    if min(x.shape) < 2:
        return out
    slopes = [
        [np.clip(slope, -MAX_CELL, MAX_CELL) * np.float32(side) for slope in np.gradient(axis)]
        for axis, side in zip(axes, squares_mm, strict=True)
    ]
    reach = float(max(np.abs(part).max() for pair in slopes for part in pair)) * 2.0
    low, high = discs[:, :2] - discs[:, 2:] - reach, discs[:, :2] + discs[:, 2:] + reach
    seen = (high[:, 0] > x.min()) & (low[:, 0] < x.max()) & (high[:, 1] > y.min()) & (low[:, 1] < y.max())
    for n in np.flatnonzero(seen):
        near = (x > low[n, 0]) & (x < high[n, 0]) & (y > low[n, 1]) & (y < high[n, 1])
        rows, columns = np.flatnonzero(near.any(axis=1)), np.flatnonzero(near.any(axis=0))
        if not len(rows):
            continue
        box = (slice(rows[0], rows[-1] + 1), slice(columns[0], columns[-1] + 1))
        dx, dy = x[box] - np.float32(discs[n, 0]), y[box] - np.float32(discs[n, 1])
        from_centre = np.maximum(np.hypot(dx, dy), np.float32(1e-9))
        sides = np.abs([(dx * sx[box] + dy * sy[box]) / from_centre for sx, sy in zip(*slopes, strict=True)])
        out[box] = np.maximum(out[box], _inside(np.float32(discs[n, 2]) - from_centre, sides))
    return out


def _inside(distance: Float32, sides: Float32) -> Float32:
    """Return the share of each cell on the positive side of an edge; the integral of a trapezoid."""
    wide, narrow = np.maximum(sides.max(axis=0), MIN_CELL), np.maximum(sides.min(axis=0), MIN_CELL)
    far = np.abs(distance)
    slope = np.clip(far - 0.5 * (wide - narrow), 0.0, narrow)
    share = (np.minimum(far, 0.5 * (wide + narrow)) - slope * slope / (2.0 * narrow)) / wide
    return np.asarray(0.5 + np.copysign(share, distance), np.float32)
