"""Calls of the kernels in sweep.c: the costs of a sweep through the ranges, and its surfaces of least cost."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from rigkit.core.arrays import FloatArray
from rigkit.kernels import kernels
from rigkit.kernels.calls import Struct, structure
from rigkit.kernels.declarations import header
from rigkit.kernels.front import ImageOf

CENSUS_BITS: int = header().constants["CENSUS_BITS"]
"""Of a sample's census: whether each of the neighbours in 5 x 5 samples is darker."""


@structure("sweep_t")
class _SweptRanges(Struct):
    """Samples of image 1, and where image 2 shows them at each range."""


@structure("surface_rules_t")
class _SurfaceRules(Struct):
    """What steps of a surface from level to level cost."""


@structure("claims_t")
class _Claims(Struct):
    """Surfaces at some samples, and which samples around are asked about them."""


def swept_costs(
    image2: NDArray[np.float32], samples1: NDArray[np.float32], table: NDArray[np.float32], spacing: int
) -> NDArray[np.uint8]:
    """Return the bits in which the census of `samples1` (R, C) and of image 2 differ at each of K levels, (R, C, K').

    `table` (K, r, c, 2) are the places in image 2 of every `spacing`-th sample, NaN where there is none. Where image 2
    shows nothing it is half of the bits. K' is K and what fills up vectors: levels of high cost.
    """
    rows, columns = samples1.shape
    sweep = _SweptRanges.of(table=table, spacing=spacing, rows=rows, columns=columns)
    return np.asarray(kernels().sweep_costs(sweep, ImageOf.of(brightness=image2), samples1))


def swept_surfaces(
    costs: NDArray[np.uint8], levels: int, samples1: NDArray[np.float32], *, bend: int, jump: int, even: float
) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
    """Return the best of `levels` >= 3 for each sample (R, C), and costs (R, C, 4): its own; of the three around it.

    A step to the next level costs `bend`, any larger one `jump` where the brightness of `samples1` is even. Both
    together are below 120.
    """
    rows, columns = samples1.shape
    rules = _SurfaceRules.of(rows=rows, columns=columns, levels=levels, bend=bend, jump=jump, even=even)
    total = kernels().sweep_surfaces(rules, costs, samples1)
    winners: tuple[NDArray[np.int32], NDArray[np.int32]] = kernels().sweep_winners(rules, total)
    return winners


def swept_rivals(
    costs: NDArray[np.uint8],
    levels: int,
    samples1: NDArray[np.float32],
    samples: NDArray[np.int64],
    surfaces: FloatArray,
    *,
    radius: float,
    alike: float,
) -> NDArray[np.float32]:
    """Return for each of N surfaces its costs, and those of the cheapest other one of the same slant, (N, 2).

    Both are bits a sample, over the samples around that are as bright: those further away than `radius` samples, or
    different by more than `alike`, count little. NaN where the sweep has none of `levels` there.

    `surfaces` (N, 4) at `samples` (N, 2), row and column: the level there, its change from row to row and from column
    to column, and how many levels away another surface begins.
    """
    rows, columns = samples1.shape
    claims = _Claims.of(
        samples=np.ascontiguousarray(samples, np.int32),
        surfaces=np.ascontiguousarray(surfaces, np.float32),
        rows=rows,
        columns=columns,
        levels=levels,
        radius=radius,
        alike=alike,
    )
    return np.asarray(kernels().sweep_rivals(claims, costs, samples1))
