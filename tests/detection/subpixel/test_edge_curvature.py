"""Curvature of rows and columns against that of known curves."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from rigkit.cameras.kannala_brandt import KannalaBrandt
from rigkit.detection.lattice.local_fit import fit_cells
from rigkit.detection.subpixel.edge_curvature import line_curvature

TRUE_REL = 0.05
"""At the ends of rows of eight corners that bend by a fifth of a cell."""


HONEST = 1.2
"""Errors in sigmas: what coefficients are expected to be is a rule of thumb, on the safe side."""


def circles(side_px: float, radius_px: float) -> np.ndarray:
    """Return (6, 8, 2): rows on circles about one centre, which the columns point to."""
    row, column = np.mgrid[:6, :8].astype(float)
    angle, distance = (column - 3.0) * side_px / radius_px, radius_px + side_px * row
    return np.stack([distance * np.sin(angle), distance * np.cos(angle)], axis=-1)


def curvature_of_rows(see: Callable[..., np.ndarray], column: np.ndarray, row: np.ndarray) -> np.ndarray:
    """Return by differences how rows bend that are seen at `see(column, row)`, (..., 2)."""
    before, here, after = (see(column + step, row) for step in (-0.01, 0.0, 0.01))
    first, second = (after - before) / 0.02, (after - 2.0 * here + before) / 1e-4
    return (first[..., 0] * second[..., 1] - first[..., 1] * second[..., 0]) / np.linalg.norm(first, axis=-1) ** 3


def sides_of(pixels: np.ndarray, cells: np.ndarray) -> np.ndarray:
    shape = fit_cells(pixels, cells)
    return np.linalg.norm(np.stack([shape.along_column, shape.along_row], axis=1), axis=2)


def curvature(pixels: np.ndarray, sigma_px: float) -> np.ndarray:
    cells = np.ones(pixels.shape[:2], bool)
    found, _ = line_curvature(pixels, np.full(cells.shape, sigma_px), cells, sides_of(pixels, cells))
    return found.reshape(*cells.shape, 2)


def test_circles_and_straight_lines() -> None:
    found = curvature(circles(20.0, 300.0), 1e-3)
    true = 1.0 / (300.0 + 20.0 * np.arange(6.0))
    # Rows run to the right and bend towards the centre, which is above: +90 degrees is below.
    assert np.abs(found[..., 0] / -true[:, None] - 1.0).max() < TRUE_REL
    assert np.abs(found[..., 1]).max() < 1e-6


def test_sigmas_are_honest_where_squares_turn_far(rng: np.random.Generator) -> None:
    """The view of a plane 0.5 rad aside through an equidistant fisheye: lines turn by up to a quarter of a radian."""
    row, column = np.mgrid[:4, :5].astype(float)

    def see(column: np.ndarray, row: np.ndarray) -> np.ndarray:
        x, y = 0.24 * column - 0.2, 0.24 * row + 0.4
        radius = np.hypot(x, y)
        return 190.0 * (np.arctan(radius) / radius)[..., None] * np.stack([x, y], axis=-1)

    pixels, true = see(column, row), curvature_of_rows(see, column, row)
    cells = np.ones(pixels.shape[:2], bool)
    sides = sides_of(pixels, cells)
    for noise in (1e-3, 1e-2, 5e-2):
        z = []
        for _ in range(20):
            noisy = pixels + rng.normal(0.0, noise, pixels.shape)
            found, sigma = line_curvature(noisy, np.full(cells.shape, noise), cells, sides)
            z.append((found[:, 0] - true.ravel()) / sigma[:, 0])
        assert np.sqrt(np.mean(np.square(z))) < HONEST


def test_noise_does_not_bend_much(rng: np.random.Generator) -> None:
    """Noise of a tenth of a pixel on straight rows: a curvature that moves no corner by as much as that."""
    row, column = np.mgrid[:6, :8].astype(float)
    straight = 20.0 * np.stack([column, row], axis=-1)
    found = np.stack([curvature(straight + rng.normal(0.0, 0.1, straight.shape), 0.1) for _ in range(50)])
    # A window of 20 px turns curvature into some 17 px^2 of displacement.
    assert 17.0 * np.sqrt((found**2).mean()) < 0.3 * 0.1


def test_ends_of_rows_in_a_fisheye() -> None:
    """Where a local cubic is one-sided: better than it by far, against the lens's own curves."""
    camera = KannalaBrandt((640, 480), np.array([230.0, 230.0, 323.0, 237.0, -0.012, -0.004, 0.001, -0.0002]))

    def see(column: np.ndarray, row: np.ndarray) -> np.ndarray:
        points = np.stack([50.0 * column - 80.0, 50.0 * row - 300.0, np.full_like(row, 300.0)], axis=-1)
        return camera.project(points)[0]

    row, column = np.mgrid[:6, :8].astype(float)
    pixels, true = see(column, row), curvature_of_rows(see, column, row)
    assert np.abs(true).max() > 1e-3
    ours = np.abs(curvature(pixels, 1e-3)[..., 0] - true)
    cubic = np.abs(fit_cells(pixels, np.ones((6, 8), bool)).curvature()[:, 0].reshape(6, 8) - true)
    assert ours.max() < 2e-4
    assert np.sqrt((ours**2).mean()) < 0.4 * np.sqrt((cubic**2).mean())
