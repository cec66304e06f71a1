"""Calls of the kernels in linearise.c, schur.c and leverage.c: the normal equations of views of boards."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rigkit.core.arrays import BoolArray, FloatArray
from rigkit.kernels import kernels
from rigkit.kernels.calls import Struct, make_struct, structure


@structure("board_views_t")
class BoardViews(Struct):
    """Views of boards, padded to the same number of corners: poses, boards, pixels, weights; members as in api.h."""

    def placed(self, first: int, stop: int) -> tuple[FloatArray, FloatArray]:
        """Return the lever arms R X and the points R X + t, (3, N) mm each, of the corners of views `first` to `stop`
        (exclusive)."""
        placed: tuple[FloatArray, FloatArray] = kernels().place_corners(self, first, (stop - first) * self.corners)
        return placed


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class ViewSums:
    """Sums over views: `residuals` (2, V, C) px, which corners are `valid` (V, C), `costs` (V,) px^2, and per view the
    `products` (V, K, K) of the columns of its weighted rows: derivatives by the parameters, the warp and the pose (w,
    t), and the residual. Those of the released points are `own` (R, 3, K + 3), with the columns of their corners and
    their own three, and `poses` (V, R, 3, 6).
    """

    seen: BoardViews
    residuals: FloatArray
    valid: BoolArray
    costs: FloatArray
    products: FloatArray
    own: FloatArray
    poses: FloatArray
    _struct: Struct = field(repr=False)

    @classmethod
    def of(cls, seen: BoardViews, across: int) -> ViewSums:
        """Return the sums of K = `across` columns, before any view is added."""
        v, c, r = seen.views, seen.corners, seen.released
        arrays: dict[str, NDArray[Any]] = {
            "residuals": np.empty((2, v, c)),
            "valid": np.empty((v, c), dtype=bool),
            "costs": np.empty(v),
            "products": np.empty((v, across, across)),
            "own": np.zeros((r, 3, across + 3)),
            "poses": np.zeros((v, r, 3, 6)),
        }
        return cls(seen=seen, **arrays, _struct=make_struct("view_sums_t", **arrays))

    def add(
        self,
        first: int,
        d_pixels_d_point: FloatArray,
        d_pixels_d_parameters: FloatArray,
        projected: tuple[FloatArray, FloatArray, BoolArray],
        lever: FloatArray,
    ) -> None:
        """Add the views from `first` on, with N corners in total: `d_pixels_d_point` (2, 3, N), `d_pixels_d_parameters`
        (2, P, N), the values of `Camera.derivatives`, and the `lever` arms (3, N)."""
        kernels().add_views(self.seen, first, d_pixels_d_point, d_pixels_d_parameters, *projected, lever, self._struct)


def schur_step(
    gg: FloatArray, gp: FloatArray, pp: FloatArray, g: FloatArray, p: FloatArray, damping: float
) -> tuple[FloatArray, FloatArray, float] | None:
    """Return the damped step of globals (G,) and poses (V, 6), and the decrease of the cost under the undamped
    quadratic model; None if the damped system is not positive definite.

    `damping` times the diagonal (times one where that vanishes) is added to the diagonal.

    Parameters
    ----------
    gg, gp, pp : (G, G), (V, G, 6) and (V, 6, 6) of J^T W J: globals, globals with poses, poses.
    g, p : (G,) and (V, 6) of J^T W r.
    """
    normal = make_struct("normal_equations_t", gg=gg, gp=gp, pp=pp, g=g, p=p)
    positive_definite, step_g, step_p, predicted = kernels().solve_schur(normal, damping)
    return (step_g, step_p, float(predicted[0])) if positive_definite else None


def chebyshev_series(matrices: FloatArray, vectors: FloatArray, bound: float, series: FloatArray) -> FloatArray:
    """Return sum_k series[k] T_k(2 M / bound - 1) z for symmetric matrices M (N, n, n) and vectors z (N, K, n).

    `series` has two terms or more; the eigenvalues of M lie between 0 and `bound`.
    """
    return np.asarray(kernels().sum_series(matrices, vectors, bound, series))
