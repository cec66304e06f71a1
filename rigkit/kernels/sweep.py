"""Calls of the kernels in sweep.c and sweep_planes.c: a sweep over ranges, its surface of minimal cost, its planes."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rigkit.core.arrays import BoolArray, FloatArray, IntArray
from rigkit.kernels import kernels
from rigkit.kernels.calls import make_struct
from rigkit.kernels.declarations import header
from rigkit.kernels.front import ImageOf

CENSUS_BITS: int = header().constants["CENSUS_BITS"]
"""Bits of a sample's census: whether each of its neighbours in 5 x 5 samples is darker."""


def swept_costs(
    image2: NDArray[np.float32], samples1: NDArray[np.float32], table: NDArray[np.float32], spacing: int
) -> NDArray[np.uint8]:
    """Return the number of different census bits of `samples1` (R, C) and image 2 at each of K levels, (R, C, K').

    `table` (K, r, c, 2) are the positions in image 2 of every `spacing`-th sample, NaN where undefined. Outside image 2
    half of the bits count as different. K' is K padded to whole vectors, with levels of high cost.
    """
    rows, columns = samples1.shape
    sweep = make_struct("sweep_t", table=table, spacing=spacing, rows=rows, columns=columns)
    return np.asarray(kernels().sweep_costs(sweep, ImageOf.of(brightness=image2), samples1))


def swept_surfaces(
    costs: NDArray[np.uint8], levels: int, samples1: NDArray[np.float32], *, bend: int, jump: int, even: float
) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
    """Return the best of `levels` >= 3 for each sample (R, C), and costs (R, C, 4): its own, and the three around it.

    A change by one level costs `bend`, a larger one `jump` where the brightness of `samples1` is uniform. Their sum
    must be below 120.
    """
    rows, columns = samples1.shape
    rules = make_struct("surface_rules_t", rows=rows, columns=columns, levels=levels, bend=bend, jump=jump, even=even)
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
    """Return the cost of each of N surfaces and that of the cheapest other surface with the same slant, (N, 2).

    Both are bits per sample, averaged over neighbouring samples with weights that decrease beyond `radius` samples and
    for differences of brightness above `alike`. NaN if the sweep has no such level there.

    `surfaces` (N, 4) at `samples` (N, 2), row and column: the level there, its change per row and per column, and the
    smallest difference in levels of another surface.
    """
    rows, columns = samples1.shape
    claims = make_struct(
        "claims_t",
        samples=np.ascontiguousarray(samples, np.int32),
        surfaces=np.ascontiguousarray(surfaces, np.float32),
        rows=rows,
        columns=columns,
        levels=levels,
        radius=radius,
        alike=alike,
    )
    return np.asarray(kernels().sweep_rivals(claims, costs, samples1))


class LevelPlanes(NamedTuple):
    """Planes (N, 3): the level, its change per row and per column; normal matrices of their fits (N, 3, 3), share (N,)
    of the samples around that agree, and the variance (N,) of their levels about the plane."""

    planes: FloatArray
    normals: FloatArray
    agree: FloatArray
    variance: FloatArray


def fitted_level_planes(
    winners: FloatArray,
    seen: BoolArray,
    brightness: NDArray[np.float32],
    samples: IntArray,
    *,
    reach: int,
    radius: float,
    alike: float,
) -> LevelPlanes:
    """Return the planes of the surface `winners` (R, C), in levels, around `samples` (N, 2), row and column.

    Only the samples `seen` (R, C) count, with weights that decrease with their distance (Gaussian, `radius` samples, up
    to `reach`), with the difference of their `brightness` (R, C; by a factor of e for `alike` grey levels), and with
    their distance from the plane (Geman and McClure, one level; four in the first round).
    """
    grid = make_struct(
        "level_grid_t",
        winners=winners,
        seen=seen.view(np.uint8),
        brightness=brightness,
        samples=np.ascontiguousarray(samples, np.int32),
        reach=reach,
        radius=radius,
        alike=alike,
    )
    planes, normals, agreement = kernels().fit_level_planes(grid)
    return LevelPlanes(planes, normals, agreement[:, 0], agreement[:, 1])
