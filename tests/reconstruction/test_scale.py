"""Metric scale: exact without noise, robust, and with true sigmas."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from rigkit.core.boards import Board
from rigkit.core.errors import DegenerateError, InputError
from rigkit.geometry.rotation import exp_so3
from rigkit.reconstruction.scale import board_scales_and_gradients, metric_scale

BOARDS = (Board("a", 8, 6, 40.0, 40.0), Board("b", 7, 5, 30.0, 31.0))
TRUE = 250.0


def reconstruction(rng, sigma=0.0):
    """Points of both boards in units of 250 mm, ten times noisier along z, with covariances."""
    points, index, grid = [], [], []
    for b, board in enumerate(BOARDS):
        R = exp_so3(rng.normal(size=3))
        points.append((board.points() @ R.T + rng.normal(size=3) * 500.0) / TRUE)
        index.append(np.full(board.corner_count, b))
        grid.append(board.grid())
    exact = np.concatenate(points)
    spread = np.array([1.0, 1.0, 10.0]) * sigma
    covariance = np.broadcast_to(np.diag(np.maximum(spread, 1e-9) ** 2), (len(exact), 3, 3))
    noisy = exact + rng.normal(size=exact.shape) * spread
    return noisy, np.concatenate(index), np.concatenate(grid), covariance


def neighbour_median(points, index, grid):
    ratios = []
    for b, board in enumerate(BOARDS):
        lattice = np.full((board.rows, board.columns, 3), np.nan)
        on = index == b
        lattice[grid[on, 1], grid[on, 0]] = points[on]
        ratios.append(board.square_x_mm / np.linalg.norm(np.diff(lattice, axis=1), axis=2).ravel())
        ratios.append(board.square_y_mm / np.linalg.norm(np.diff(lattice, axis=0), axis=2).ravel())
    return np.median(np.concatenate(ratios))


def test_exact_points_give_the_exact_scale(rng):
    points, index, grid, covariance = reconstruction(rng)
    for c in (None, covariance):
        scale, _, _ = metric_scale(points, index, grid, BOARDS, c)
        assert scale == pytest.approx(TRUE, rel=1e-10)


def test_sigma_is_that_of_monte_carlo_and_beats_neighbours(rng):
    found, sigmas, plain, median = [], [], [], []
    for _ in range(150):
        points, index, grid, covariance = reconstruction(rng, 1e-3)
        scale, sigma, _ = metric_scale(points, index, grid, BOARDS, covariance)
        found.append(scale - TRUE)
        sigmas.append(sigma)
        plain.append(metric_scale(points, index, grid, BOARDS)[0] - TRUE)
        median.append(neighbour_median(points, index, grid) - TRUE)
    rms = np.sqrt(np.mean(np.square(found)))
    # 150 runs know a standard deviation to 6 %.
    assert rms == pytest.approx(np.sqrt(np.mean(np.square(sigmas))), rel=0.15)
    assert abs(np.mean(found)) < 4.0 * rms / np.sqrt(150)
    assert rms < np.sqrt(np.mean(np.square(plain)))
    assert rms < 0.2 * np.sqrt(np.mean(np.square(median)))


def test_bad_corners_and_missing_ones_do_not_matter(rng):
    points, index, grid, covariance = reconstruction(rng, 1e-4)
    clean, sigma, _ = metric_scale(points, index, grid, BOARDS, covariance)
    points[[3, 20, 60]] += [[0.2, -0.1, 0.3], [0.5, 0.2, 0.1], [-0.3, 0.3, 0.2]]
    points[[7, 9]] = np.nan
    dirty, _, _ = metric_scale(points, index, grid, BOARDS, covariance)
    assert abs(dirty - clean) < 3.0 * sigma


def test_stated_square_sigma_enters(rng):
    points, index, grid, covariance = reconstruction(rng, 1e-5)
    boards = (replace(BOARDS[0], square_sigma_mm=0.4), replace(BOARDS[1], square_sigma_mm=0.003))
    scale, sigma, _ = metric_scale(points, index, grid, boards, covariance)
    # 1 % of one board and 0.01 % of the other: the second decides.
    assert sigma == pytest.approx(scale * 1e-4, rel=0.2)
    each, *_ = board_scales_and_gradients(points, index, grid, boards, covariance)
    assert abs(scale - each[1]) < 0.05 * abs(each[0] - each[1]) + 1e-6


def test_boards_are_also_judged_singly(rng):
    points, index, grid, covariance = reconstruction(rng, 1e-4)
    wrong = (BOARDS[0], replace(BOARDS[1], square_x_mm=33.0, square_y_mm=34.1))
    each, variance, _ = board_scales_and_gradients(points, index, grid, wrong, covariance)
    assert each[1] / each[0] == pytest.approx(1.1, abs=0.01)
    assert abs(each[1] - each[0]) > 10.0 * np.sqrt(variance.sum())


def test_too_few_corners_is_an_error(rng):
    points, index, grid, _ = reconstruction(rng)
    with pytest.raises(DegenerateError, match="no scale"):
        metric_scale(points[:3], index[:3], grid[:3], BOARDS)
    row = (index == 0) & (grid[:, 1] == 0)
    with pytest.raises(DegenerateError, match="no scale"):
        metric_scale(points[row], index[row], grid[row], BOARDS)
    with pytest.raises(InputError, match="board indices"):
        metric_scale(points, index[:5], grid, BOARDS)


@pytest.mark.parametrize("weighted", [True, False])
def test_the_gradient_is_that_of_differences(rng, weighted):
    points, index, grid, covariance = reconstruction(rng, 1e-4)
    known = (index, grid, BOARDS, covariance if weighted else None)
    scale, _, gradient = metric_scale(points, *known)
    # Smooth motions, as those of a pose are: a turn of the depths and a stretch.
    for motion in (points * [0.3, 0.1, -0.2], np.cross(points, [0.2, -0.4, 0.1])):
        step = 1e-6
        ahead, back = (metric_scale(points + sign * step * motion, *known)[0] for sign in (1.0, -1.0))
        assert np.sum(gradient * motion) == pytest.approx((ahead - back) / (2.0 * step), rel=0.01, abs=1e-3 * scale)


def test_a_corner_that_comes_twice_counts_twice(rng):
    points, index, grid, covariance = reconstruction(rng, 1e-4)
    again = np.r_[np.arange(len(points)), 7]
    scale, sigma, _ = metric_scale(points[again], index[again], grid[again], BOARDS, covariance[again])
    assert abs(scale - TRUE) < 5.0 * sigma


def test_points_that_coincide_have_no_scale(rng):
    points, index, grid, covariance = reconstruction(rng)
    with pytest.raises(DegenerateError, match="no scale"):
        metric_scale(np.zeros_like(points), index, grid, BOARDS, covariance)
    points[index == 0] = points[0]
    assert metric_scale(points, index, grid, BOARDS, covariance)[0] == pytest.approx(TRUE)
