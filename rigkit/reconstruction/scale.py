"""Estimate the metric scale of a reconstruction from boards whose squares were measured.

Each board is a rigid, scaled copy of its grid: p_i = k (R g_i + c) with p in the unit of the reconstruction and g in
mm. The scale is the robust maximum-likelihood estimate under the points' covariances. It uses all distances on the
board, and is several times more precise than the median distance of neighbouring corners.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from rigkit.core.arrays import TINY, FloatArray, IntArray, Points
from rigkit.core.boards import Board
from rigkit.core.errors import DegenerateError, InputError
from rigkit.geometry.rotation import exp_so3, nearest_rotation, skew
from rigkit.optim.robust_scale import MEDIAN_OF_CHI_SQUARE_3

MIN_CORNERS_FOR_SCALE = 4
OUTLIER_SQUARE = 14.2
"""Squared Mahalanobis distance (three components) from which a corner is downweighted: one in 400 Gaussian ones."""
SCALE_ITERATIONS = 15


def metric_scale(
    points_unit: Points,
    board_index: IntArray,
    grid: IntArray,
    boards: Sequence[Board],
    covariances: FloatArray | None = None,
) -> tuple[float, float, FloatArray]:
    """Return mm per unit of the reconstruction, its standard deviation, and its derivative (N, 3) by the points.

    Raises DegenerateError if no board has enough corners.

    Parameters
    ----------
    points_unit : (N, 3) triangulated corners; NaN rows are ignored.
    board_index : (N,) index into `boards`; -1 if the point is on none.
    grid : (N, 2) int, (column, row).
    boards : with their measured squares; `square_sigma_mm` enters the standard deviation and the weight.
    covariances : (N, 3, 3) of the points in the unit of the reconstruction; None: equal and estimated from the fit.

    Notes
    -----
    The standard deviation is for a fixed pose of the cameras. The caller adds the pose's uncertainty. The derivative is
    that of the least-squares problem with its final weights held: zero for points that were left out.
    """
    scales, variance, slopes = board_scales_and_gradients(points_unit, board_index, grid, boards, covariances)
    known = np.isfinite(scales)
    weights = np.where(known, 1.0 / np.maximum(np.where(known, variance, 1.0), TINY), 0.0)
    total = weights.sum()
    gradient = np.einsum("b,bni->ni", weights, slopes) / total
    return float(np.sum(weights * np.where(known, scales, 0.0)) / total), float(total**-0.5), gradient


def board_scales_and_gradients(
    points_unit: Points,
    board_index: IntArray,
    grid: IntArray,
    boards: Sequence[Board],
    covariances: FloatArray | None = None,
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return every board's scale (B,), its variance (B,) with that of the squares, and its derivative by the points.

    If boards disagree by many standard deviations, a square size or the pose is wrong. The derivatives are (B, N, 3);
    scales that are not determined are NaN. See `metric_scale` for parameters and errors.
    """
    points = np.asarray(points_unit, dtype=np.float64)
    index, cells = np.asarray(board_index), np.asarray(grid)
    if len(index) != len(points) or len(cells) != len(points):
        raise InputError(f"scale: {len(points)} points, {len(index)} board indices and {len(cells)} grid positions")
    finite = np.isfinite(points).all(axis=1)
    if covariances is not None:
        finite &= np.isfinite(covariances).all(axis=(-2, -1))
    scales, sigmas = np.full(len(boards), np.nan), np.full(len(boards), np.nan)
    slopes = np.zeros((len(boards), len(points), 3))
    for b, board in enumerate(boards):
        on = finite & (index == b)
        if on.sum() < MIN_CORNERS_FOR_SCALE:
            continue
        model = board.points(cells[on])
        # A single row of corners would determine the scale, but is typical of a wrong detection.
        if np.linalg.matrix_rank(model - model.mean(axis=0)) < 2:
            continue
        found = _similarity_scale(points[on], model, None if covariances is None else covariances[on])
        if found is not None:
            scales[b], sigmas[b], slopes[b, on] = found
    if not np.isfinite(scales).any():
        raise DegenerateError(
            f"no scale: none of {len(boards)} boards has {MIN_CORNERS_FOR_SCALE} triangulated corners that span it; "
            "take images in which both cameras see one whole"
        )
    return scales, sigmas**2 + (scales * square_sigmas(boards)) ** 2, slopes


def square_sigmas(boards: Sequence[Board]) -> FloatArray:
    """Return the relative standard deviations (B,) of the squares; 0 if none is stated."""
    return np.array([(b.square_sigma_mm or 0.0) / min(b.square_x_mm, b.square_y_mm) for b in boards])


def _similarity_scale(
    points: Points, model: Points, covariances: FloatArray | None
) -> tuple[float, float, FloatArray] | None:
    """Return mm per unit, its standard deviation and its gradient (N, 3) for one board; None if not determined."""
    centred = model - model.mean(axis=0)
    k, R, c = _robust_start(points, centred)
    if not k > 0.0:
        return None
    if covariances is None:
        whiten = np.broadcast_to(np.eye(3), (len(points), 3, 3))
    else:
        floor = 1e-12 * np.trace(covariances, axis1=1, axis2=2)[:, None, None] * np.eye(3)
        whiten = np.linalg.inv(np.linalg.cholesky(covariances + floor))
    noise, gram = 1.0, np.eye(7)
    # The weights, and so the cost, change at every step; `rigkit.optim` needs a fixed cost.
    for iteration in range(SCALE_ITERATIONS):
        turned = centred @ R.T
        residual = np.einsum("nij,nj->ni", whiten, points - k * turned - c)
        square = np.sum(residual**2, axis=1)
        if covariances is None:
            noise = max(float(np.median(square)) / MEDIAN_OF_CHI_SQUARE_3, TINY)
        w = np.minimum(1.0, noise * OUTLIER_SQUARE / np.maximum(square, TINY)) ** 2
        J = np.concatenate([turned[:, :, None], -k * skew(turned), np.broadcast_to(np.eye(3), whiten.shape)], axis=2)
        J = whiten @ J
        gram = np.einsum("n,nij,nik->jk", w, J, J)
        step = np.linalg.solve(gram, np.einsum("n,nij,ni->j", w, J, residual))
        k, R, c = k + step[0], exp_so3(step[1:4]) @ R, c + step[4:]
        if iteration > 1 and abs(step[0]) < 1e-10 * k:
            break
    if not k > 0.0:
        return None
    spread = float(np.sum(w * square)) / max(3.0 * w.sum() - 7.0, 1.0)
    spread = spread if covariances is None else max(spread, 1.0)
    inverse = np.linalg.inv(gram)
    d_scale_d_points = np.einsum("j,n,nij,nik->nk", inverse[0], w, J, whiten)
    return 1.0 / k, float(np.sqrt(spread * inverse[0, 0])) / k**2, -d_scale_d_points / k**2


def _robust_start(points: Points, centred: Points) -> tuple[float, FloatArray, FloatArray]:
    """Return initial values: unit per mm (median of all distance ratios), rotation and centre."""
    first, second = np.triu_indices(len(points), 1)
    between = np.linalg.norm(points[first] - points[second], axis=1)
    grid = np.linalg.norm(centred[first] - centred[second], axis=1)
    k = float(np.median(between[grid > 0.0] / grid[grid > 0.0]))
    c = np.median(points, axis=0)
    R = nearest_rotation((points - c).T @ centred)
    for _ in range(5):
        off = points - k * centred @ R.T - c
        size = np.linalg.norm(off, axis=1)
        w = 1.0 / np.maximum(size, 0.1 * np.median(size) + TINY)
        mean_p, mean_m = w @ points / w.sum(), w @ centred / w.sum()
        R = nearest_rotation((points - mean_p).T * w @ (centred - mean_m))
        c = mean_p - k * R @ mean_m
    return k, R, c
