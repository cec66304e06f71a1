"""Calls of the kernel in planes.c: local planes through measurements at the nodes of a grid."""

from __future__ import annotations

from typing import NamedTuple

from rigkit.core.arrays import FloatArray
from rigkit.kernels import kernels
from rigkit.kernels.calls import make_struct


class PlaneFits(NamedTuple):
    """Planes (R, C, 3), normal matrices of their fits (R, C, 3, 3), sums of weights (R, C), and weighted sums of
    squared Mahalanobis distances (R, C). For a curvature (uu, uv, vv) fitted together with a plane: the rest of the
    normal matrix, `mixed` by plane and curvature and `bends` (R, C, 3, 3), and `pull` (R, C, 3) the right side at the
    plane. NaN where there is no plane."""

    planes: FloatArray
    normals: FloatArray
    support: FloatArray
    squares: FloatArray
    mixed: FloatArray
    bends: FloatArray
    pull: FloatArray


def fitted_planes(
    values: FloatArray,
    information: FloatArray,
    frames: FloatArray,
    *,
    offsets: FloatArray,
    windows: FloatArray,
    step: float,
    reach: int,
    rounds: int,
    turn: float,
) -> PlaneFits:
    """Return the planes through the measurements at the nodes.

    `values` (R, C, 3), NaN where unknown, with their `information` (R, C, 3, 3); `frames` (R, C, 3, 3) map a plane to
    its predicted values. A neighbour at the Mahalanobis distance s from a plane has the weight 1 / (1 + s^2 / (3
    turn^2))^2 (Geman and McClure), in the first round with the uncertainty of the node's own plane added.

    Values are those of tangent planes at the middle of windows, of the variances `windows` (R, C) px^2, around nodes
    that are `step` px apart, and hold at `offsets` (R, C, 2) px from these. Over a window with the variance s, whose
    middle is d px from the node's point, a surface with the curvature k adds k(d, d) / 2 + k s / 2 + k(d, offset) to
    the first value and k d to the others.
    """
    grid = make_struct(
        "plane_grid_t",
        values=values,
        information=information,
        frames=frames,
        offsets=offsets,
        windows=windows,
        step=step,
        reach=reach,
        rounds=rounds,
        turn=turn,
    )
    done, *fits = kernels().fit_planes(grid)
    if not done:
        raise MemoryError
    return PlaneFits(*fits)
