"""Sigmas of boards of few corners are raised to the observed scatter, without counting lens distortion."""

from __future__ import annotations

import numpy as np
import pytest

from rigkit.detection.subpixel.scatter import scatter_factors, small_scatter

SIGMA_PX = 0.02


def corners(columns: int, rows: int, bend: float = 0.0) -> np.ndarray:
    """Return corners (R, C, 2) seen aslant, 30 px apart, pulled towards the middle of the image by a lens."""
    u, v = np.meshgrid(np.arange(columns) - 1.7, np.arange(rows) - 1.2)
    u, v = (30.0 * part / (1.0 + 0.03 * u - 0.02 * v) for part in (u, v))
    squared = (u**2 + v**2) / 100.0**2
    return np.stack([u, v], axis=-1) / np.sqrt(1.0 + bend * squared)[..., None]


def final_factor(pixels: np.ndarray, sigma_px: float) -> float:
    """Return the factor of the sigmas of corners (R, C, 2), by both tests of scatter in turn."""
    rows, columns = pixels.shape[:2]
    sigmas = np.full((rows, columns), sigma_px)
    factor = float(scatter_factors(pixels, sigmas, [(slice(0, rows), slice(0, columns))])[0])
    return factor * small_scatter(pixels, factor * sigmas)


@pytest.mark.parametrize(("times", "low", "high"), [(1.0, 1.0, 1.3), (4.0, 3.0, 5.0)])
def test_scatter_raises_sigmas(times: float, low: float, high: float) -> None:
    rng = np.random.default_rng(4)
    sigma_px = np.full((6, 4), SIGMA_PX)
    noise = times * SIGMA_PX * rng.standard_normal((20, 6, 4, 2))
    factors = [small_scatter(corners(4, 6) + one, sigma_px) for one in noise]
    assert low <= np.median(factors) <= high


def test_sigmas_of_boards_whose_columns_have_no_differences_are_raised_too() -> None:
    """A board of 7 x 5 has 20 differences along its rows, as few as chance."""
    rng = np.random.default_rng(5)
    sigma_px = np.full((5, 7), SIGMA_PX)
    noise = SIGMA_PX * rng.standard_normal((20, 5, 7, 2))
    for times in (1.0, 4.0):
        factors = [small_scatter(corners(7, 5) + times * one, sigma_px) for one in noise]
        assert np.median(factors) == pytest.approx(times, rel=0.2)


def test_lens_distortion_does_not_raise_sigmas() -> None:
    sigma_px = np.full((6, 4), 0.001)
    bent = corners(4, 6, bend=2.0) + 0.001 * np.random.default_rng(1).standard_normal((6, 4, 2))
    assert small_scatter(bent, sigma_px) == 1.0


@pytest.mark.parametrize(("times", "low", "high"), [(1.0, 1.0, 2.0), (6.0, 4.0, 8.0)])
def test_a_small_board_that_faces_a_fisheye(times: float, low: float, high: float) -> None:
    """Its bend is odd, so that quartic surfaces fit no better than cubic ones, and as smooth as scatter of order 5."""
    rng = np.random.default_rng(3)
    sigma_px, factors = 0.004, []
    for _ in range(10):
        u, v = (0.17 * (part + rng.uniform(-0.5, 0.5)) for part in np.meshgrid(np.arange(7) - 3.0, np.arange(5) - 2.0))
        tangent = np.hypot(u, v)
        pixels = 600.0 * np.stack([u, v], axis=-1) * (np.arctan(tangent) / tangent)[..., None]
        pixels += times * sigma_px * rng.standard_normal((5, 7, 2))
        factors.append(final_factor(pixels, sigma_px))
    assert low <= np.median(factors) <= high


@pytest.mark.parametrize(("times", "low", "high"), [(1.0, 1.0, 2.0), (8.0, 4.0, 9.0)])
def test_a_small_board_near_a_fisheye(times: float, low: float, high: float) -> None:
    """Tilted, and 3 squares away: its bend seemed to be scatter, many times the sigmas."""
    rng = np.random.default_rng(7)
    sigma_px, factors = 0.006, []
    for _ in range(10):
        u, v = (part + rng.uniform(-0.5, 0.5) for part in np.meshgrid(np.arange(7) - 3.0, np.arange(5) - 2.0))
        depth = 3.0 + 0.07 * u * rng.uniform(-1.0, 1.0) + 0.3 * v
        beside = np.hypot(u, v)
        pixels = 240.0 * np.stack([u, v], axis=-1) * (np.arctan2(beside, depth) / beside)[..., None]
        pixels += times * sigma_px * rng.standard_normal((5, 7, 2))
        factors.append(final_factor(pixels, sigma_px))
    assert low <= np.median(factors) <= high


def test_boards_of_many_or_hardly_any_corners_are_left_to_others() -> None:
    rng = np.random.default_rng(2)
    for columns, rows in ((9, 6), (3, 3)):
        scattered = corners(columns, rows) + rng.standard_normal((rows, columns, 2))
        assert small_scatter(scattered, np.full((rows, columns), SIGMA_PX)) == 1.0
    assert small_scatter(np.full((4, 4, 2), np.nan), np.full((4, 4), np.nan)) == 1.0
