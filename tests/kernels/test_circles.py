"""The kernel of the circle fit against its definition."""

from __future__ import annotations

import numpy as np
import pytest
from kernels.reference.circles import picture

from rigkit.detection.circles.fit import fit_circles

SERIES_PX = 1e-3
"""The kernel's distance from the edge is a series to the second order: so far do fits depart from the definition."""
WIDE_SERIES_PX = 5e-3
"""The same at a blur of 1.7 px, where pixels farther from the edge count."""
UNEVEN_PX2 = 0.12
"""Of a narrow ellipse, whose slant and blur look nearly alike, by that series."""
CIRCLES = {
    "round": ([[12.0, 0.0], [0.0, 12.0]], [[0.0, 0.0, 0.0], [0.0, 0.0, 0.0]]),
    "slanted": ([[14.0, 3.0], [-2.0, 7.0]], [[0.3, 0.05, 0.1], [0.05, 0.15, 0.1]]),
    "turned": ([[-4.0, -9.0], [11.0, -3.0]], [[0.15, -0.1, 0.2], [0.1, 0.15, -0.15]]),
}


@pytest.mark.parametrize("name", CIRCLES)
def test_a_picture_of_the_model_gives_its_numbers_back(name: str) -> None:
    matrix, bend = (np.array(part) for part in CIRCLES[name])
    centre, slope = np.array([31.3, 29.8]), np.array([2e-3, -1e-3])
    image = picture((64, 60), centre, matrix, bend, 0.8, 200.0, -170.0, slope).astype(np.float32)
    start = centre + np.array([0.4, -0.3])
    fit = fit_circles(image, start[None], 1.05 * matrix[None], bend[None], np.array([1.0]), np.array([1.6]))
    assert fit.valid.all()
    assert np.abs(fit.pixels[0] - centre).max() < SERIES_PX
    assert fit.blur_px[0] == pytest.approx(0.8, abs=5e-3)
    assert fit.contrast[0] == pytest.approx(-170.0, rel=5e-3)
    # Size and slant without the turn that no circle shows.
    assert fit.maps[0] @ fit.maps[0].T == pytest.approx(matrix @ matrix.T, rel=2e-3, abs=0.05)
    assert fit.sigma_px[0] < 0.01


def test_a_brief_fit_is_the_same_without_the_shape_of_the_edge(rng: np.random.Generator) -> None:
    matrix, bend = (np.array(part) for part in CIRCLES["slanted"])
    image = picture((64, 60), np.array([31.3, 29.8]), matrix, bend, 0.8, 200.0, -170.0, np.zeros(2))
    noisy = (image + rng.normal(0.0, 2.0, image.shape)).astype(np.float32)
    args = (np.array([[31.0, 30.0]]), matrix[None], bend[None], np.array([1.0]), np.array([1.6]))
    whole, brief = fit_circles(noisy, *args), fit_circles(noisy, *args, brief=True)
    assert whole.valid.all() and brief.valid.all()
    assert (brief.pixels == whole.pixels).all() and (brief.maps == whole.maps).all()
    # Those at the last step, which was shorter than a twentieth of a sigma.
    assert brief.residual == pytest.approx(whole.residual, rel=1e-3)
    assert brief.covariance == pytest.approx(whole.covariance, rel=0.02, abs=1e-7)
    assert not brief.harmonics.any() and whole.harmonics.any()
    assert not brief.uneven.any() and not brief.added_light.any() and whole.added_light.any()


@pytest.mark.parametrize("name", CIRCLES)
def test_a_blur_that_differs_with_the_direction_comes_from_what_fits_leave(name: str) -> None:
    matrix, bend = (np.array(part) for part in CIRCLES[name])
    centre, uneven = np.array([31.3, 29.8]), np.array([0.9, -0.5])
    image = picture((64, 60), centre, matrix, bend, 1.4, 200.0, -170.0, np.zeros(2), (0.9, -0.5)).astype(np.float32)
    projected = np.zeros(2)
    for _ in range(5):
        args = (image, centre[None], matrix[None], bend[None], np.array([1.2]), np.array([1.7]))
        fit = fit_circles(*args, uneven_px2=projected)
        one, two, xx, xy, yy = fit.uneven[0]
        projected = projected + np.linalg.solve([[xx, xy], [xy, yy]], [one, two])
    assert projected == pytest.approx(uneven, abs=UNEVEN_PX2)
    assert fit.valid.all() and np.abs(fit.pixels[0] - centre).max() < WIDE_SERIES_PX


@pytest.mark.parametrize("name", CIRCLES)
def test_the_move_by_added_light_leads_back_to_the_centre(name: str) -> None:
    matrix, bend = (np.array(part) for part in CIRCLES[name])
    centre = np.array([31.3, 29.8])
    image = picture((64, 60), centre, matrix, bend, 0.8, 200.0, -170.0, np.zeros(2))
    image = (image + (np.arange(64.0) - centre[0])).astype(np.float32)
    fit = fit_circles(image, centre[None], matrix[None], bend[None], np.array([0.8]), np.array([1.6]))
    off, after = fit.pixels[0] - centre, fit.pixels[0] + fit.added_light[0] - centre
    assert np.linalg.norm(off) > 0.01
    assert np.linalg.norm(after) < 0.2 * np.linalg.norm(off)


def test_the_middle_of_the_ellipse_is_not_the_centre() -> None:
    matrix, bend = (np.array(part) for part in CIRCLES["slanted"])
    centre = np.array([31.3, 29.8])
    image = picture((64, 60), centre, matrix, bend, 0.8, 200.0, -170.0, np.zeros(2)).astype(np.float32)
    blind = fit_circles(image, centre[None], matrix[None], 0.0 * bend[None], np.array([0.8]), np.array([1.6]))
    assert np.linalg.norm(blind.pixels[0] - centre) > 100.0 * SERIES_PX


def test_a_circle_outside_the_image_is_not_valid() -> None:
    image = np.full((60, 64), 100.0, np.float32)
    maps, curvatures = np.tile(8.0 * np.eye(2), (2, 1, 1)), np.zeros((2, 2, 3))
    places = np.array([[-40.0, 20.0], [np.nan, 20.0]])
    fit = fit_circles(image, places, maps, curvatures, np.full(2, 0.8), np.full(2, 1.6))
    assert not fit.valid.any()
