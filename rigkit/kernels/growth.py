"""Calls of the kernels in growth.c and components.c, with the callers' tolerances."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from rigkit.core.arrays import BoolArray, FloatArray, IntArray
from rigkit.kernels import kernels
from rigkit.kernels.calls import Struct, make_struct, structure
from rigkit.kernels.front import ImageOf, RingRules


@structure("fit_rules_t", radius="MAX_FIT_RADIUS")
class FitRules(Struct):
    """Parameters of local polynomial fits."""


@structure("growth_rules_t", tried="MAX_TRIED")
class GrowthRules(Struct):
    """Parameters of the growth of lattices."""

    @classmethod
    def make(cls, predictions: Sequence[FitRules], ring: RingRules, along: np.ndarray, **numbers: float) -> GrowthRules:
        """Return the rules; `along` are the positions along an edge that are tested."""
        return cls.of(predictions=(FitRules * 2)(*predictions), ring=ring, along=along, **numbers)


@structure("squares_t")
class GridBuckets(Struct):
    """Points (N, 2), N > 0, sorted into the cells of a grid, to find those near a position."""

    @classmethod
    def sorted(cls, points: FloatArray) -> GridBuckets:
        points = np.ascontiguousarray(points, np.float64)
        memory = np.empty(kernels().squares_memory(len(points)), np.int32)
        squares = cls()
        squares._kept = {"points": points, "memory": memory}
        kernels().sort_points(points, memory, squares)
        return squares


def fit(lattice: FloatArray, cells: BoolArray, rules: FitRules) -> FloatArray:
    """Return the fits (M, 12) at the M `cells` (R, C) of `lattice` (R, C, 2), in the order of `LocalFit`."""
    return np.asarray(kernels().fit_cells(lattice, cells, rules, int(np.count_nonzero(cells))))


def grown(
    pixels: FloatArray,
    contrast: FloatArray,
    sign: float,
    image: np.ndarray,
    scale: float,
    offset: float,
    saddles: GridBuckets,
    rules: GrowthRules,
    rings: int,
) -> int:
    """Grow the lattice `pixels` (R, C, 2), `contrast` (R, C) in place; both contiguous float64, NaN where unknown.

    Returns the number of remaining rings when the lattice reaches the border of its arrays, -1 if no more can be added.
    """
    sheet = make_struct(
        "sheet_t", pixels=pixels, contrast=contrast, due=np.ones((2, *contrast.shape), np.uint8), sign=sign
    )
    level = make_struct("pyramid_level_t", image=ImageOf.of(brightness=image), scale=scale, offset=offset)
    return int(kernels().grow_lattice(sheet, level, saddles, rules, rings))


def components_of(links: IntArray) -> tuple[int, IntArray, IntArray, IntArray, IntArray]:
    """Return the number of lattices of mutual `links`, and label, grid (N, 2), turn, members of the corners.

    `links` (N, 4) are 4 * neighbour + its arm, -1 for none.
    """
    found: tuple[int, IntArray, IntArray, IntArray, IntArray] = kernels().find_components(
        np.array(links, np.int64, order="C")
    )
    return found
