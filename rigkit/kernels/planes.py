"""Calls of the kernel in planes.c: planes through what the nodes of a grid say of a surface."""

from __future__ import annotations

from typing import NamedTuple

from rigkit.core.arrays import FloatArray
from rigkit.kernels import kernels
from rigkit.kernels.calls import Struct, structure


@structure("plane_grid_t")
class _PlaneGrid(Struct):
    """What the nodes say, and how planes are fitted."""


class PlaneFits(NamedTuple):
    """Planes (R, C, 3), the normal matrices of their fits (R, C, 3, 3), the sums of weights (R, C), and those of
    weighted squares (R, C) of Mahalanobis' distances from them. NaN where there is none."""

    planes: FloatArray
    normals: FloatArray
    support: FloatArray
    squares: FloatArray


def fitted_planes(
    values: FloatArray, information: FloatArray, frames: FloatArray, *, reach: int, rounds: int, turn: float
) -> PlaneFits:
    """Return the planes through what nodes say.

    `values` (R, C, 3), NaN where there are none, their `information` (R, C, 3, 3) and `frames` (R, C, 3, 3), by which
    a plane predicts them. Of a neighbour at the Mahalanobis distance s from a plane the weight is
    1 / (1 + s^2 / (3 turn^2))^2 (Geman and McClure), in the first round with the uncertainty of the node's own plane.
    """
    grid = _PlaneGrid.of(values=values, information=information, frames=frames, reach=reach, rounds=rounds, turn=turn)
    return PlaneFits(*kernels().fit_planes(grid))
