"""Calls of the kernel in planes.c: local planes through measurements at the nodes of a grid."""

from __future__ import annotations

from typing import NamedTuple

from rigkit.core.arrays import FloatArray
from rigkit.kernels import kernels
from rigkit.kernels.calls import make_struct


class PlaneFits(NamedTuple):
    """Planes (R, C, 3), normal matrices of their fits (R, C, 3, 3), sums of weights (R, C), and weighted sums of
    squared Mahalanobis distances (R, C). NaN where there is no plane."""

    planes: FloatArray
    normals: FloatArray
    support: FloatArray
    squares: FloatArray


def fitted_planes(
    values: FloatArray, information: FloatArray, frames: FloatArray, *, reach: int, rounds: int, turn: float
) -> PlaneFits:
    """Return the planes through the measurements at the nodes.

    `values` (R, C, 3), NaN where unknown, with their `information` (R, C, 3, 3); `frames` (R, C, 3, 3) map a plane to
    its predicted values. A neighbour at the Mahalanobis distance s from a plane has the weight 1 / (1 + s^2 / (3
    turn^2))^2 (Geman and McClure), in the first round with the uncertainty of the node's own plane added.
    """
    grid = make_struct(
        "plane_grid_t", values=values, information=information, frames=frames, reach=reach, rounds=rounds, turn=turn
    )
    done, *fits = kernels().fit_planes(grid)
    if not done:
        raise MemoryError
    return PlaneFits(*fits)
