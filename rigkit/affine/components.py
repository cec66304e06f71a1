"""Directions as arrays (K, n) of single components, in blocks that fit the processor's cache.

In this layout closed forms for a million corners are passes over contiguous memory, not stacks of small matrices.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from rigkit.core.arrays import BoolArray, FloatArray
from rigkit.core.matches import DirectionPairs

CORNERS_AT_A_TIME = 8192
"""Corners worked on at a time: about fifty rows of this length fit a second-level cache."""
MIN_CONDITIONING = 0.05
"""Smallest conditioning of a valid affinity: below, noise is magnified more than twentyfold."""


@dataclass(frozen=True, eq=False, slots=True)
class PlanarDirections:
    """K directions of n corners; components are zero where not `use`.

    Attributes
    ----------
    x1, y1, x2, y2 : (K, n)
    use : (K, n) bool.
    """

    x1: FloatArray
    y1: FloatArray
    x2: FloatArray
    y2: FloatArray
    use: BoolArray

    @classmethod
    def of(cls, directions: DirectionPairs, block: slice) -> PlanarDirections:
        """Return those of the corners `block`; directions that are invalid or have zero length are not used."""
        d1 = np.ascontiguousarray(directions.image1[block].transpose(2, 1, 0))
        d2 = np.ascontiguousarray(directions.image2[block].transpose(2, 1, 0))
        use = directions.valid[block].T & (d1 != 0.0).any(axis=0) & (d2 != 0.0).any(axis=0)
        return cls(d1[0], d1[1], d2[0], d2[1], use).only(use)

    def only(self, use: BoolArray) -> PlanarDirections:
        """Return the directions with only `use` (K, n) in use."""
        components = (self.x1, self.y1, self.x2, self.y2)
        if not use.all():
            components = tuple(np.where(use, c, 0.0) for c in components)  # type: ignore[assignment]
        return PlanarDirections(*components, use)


def blocks(n: int) -> Iterator[slice]:
    """Yield slices that cover n corners."""
    for start in range(0, n, CORNERS_AT_A_TIME):
        yield slice(start, min(start + CORNERS_AT_A_TIME, n))


def finite(array: FloatArray) -> BoolArray:
    """Return which entries along the first axis of an array are finite in all components, (N,)."""
    return np.asarray(np.isfinite(array).all(axis=tuple(range(1, array.ndim))))


def first_of(use: BoolArray, count: int) -> BoolArray:
    """Return the first `count` directions in use of every corner, (K, n)."""
    if use.shape[0] <= count:
        return use
    return np.asarray(use & (np.cumsum(use, axis=0) <= count))


def last_of(use: BoolArray) -> BoolArray:
    """Return the last direction in use of every corner, (K, n)."""
    return np.asarray(use & (np.cumsum(use[::-1], axis=0)[::-1] == 1))


def unit_weights(directions: PlanarDirections) -> tuple[FloatArray, FloatArray]:
    """Return 1 / |d|^2 of either image, (K, n); 0 where not in use."""

    def inverse_square(x: FloatArray, y: FloatArray) -> FloatArray:
        square = x * x + y * y
        square += ~directions.use  # avoids 0 / 0; the masked components keep such rows at zero
        return np.asarray(directions.use / square)

    return inverse_square(directions.x1, directions.y1), inverse_square(directions.x2, directions.y2)


def smaller_eigenvalue(m11: FloatArray, m12: FloatArray, m22: FloatArray) -> FloatArray:
    """Return the smaller eigenvalue of symmetric, positive 2 x 2 matrices, without cancellation."""
    half = 0.5 * (m11 + m22)
    with np.errstate(divide="ignore", invalid="ignore"):
        root = half + np.sqrt((0.5 * (m11 - m22)) ** 2 + m12 * m12)
        return np.asarray(np.maximum(m11 * m22 - m12 * m12, 0.0) / root)


def smallest_singular(m11: FloatArray, m12: FloatArray, m22: FloatArray) -> FloatArray:
    """Return the smaller singular value of a K x 2 system from its normal matrix."""
    return np.sqrt(smaller_eigenvalue(m11, m12, m22))
