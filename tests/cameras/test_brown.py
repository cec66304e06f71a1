"""The edge of Brown's model, where the distortion folds the image back."""

from __future__ import annotations

import numpy as np
import pytest

from rigkit.cameras.brown import Brown

ROUND_TRIP_RAY = 1e-9
SIZE_PX = (1280, 960)


def _brown(*distortion: float) -> Brown:
    return Brown(SIZE_PX, np.array([800.0, 790.0, 640.0, 480.0, *distortion]))


@pytest.mark.parametrize(
    "camera",
    [
        _brown(-0.3, 0.02, 0.03, -0.05, 0.0),
        _brown(0.1, -0.2, -0.08, 0.02, 0.01),
        _brown(-0.1, 0.0, 0.05, 0.05, 0.0, 0.3, 0.02, 0.0),
    ],
)
def test_strong_tangential_distortion_folds_nothing_inside(camera: Brown, rng: np.random.Generator) -> None:
    """Everywhere inside the field of view the image keeps its orientation, and pixels come back as the same rays."""
    edge = np.tan(camera.max_angle_rad)
    r = edge * np.sqrt(rng.uniform(0.0, 0.995, 5000))
    phi = rng.uniform(-np.pi, np.pi, 5000)
    points = np.stack([r * np.cos(phi), r * np.sin(phi), np.ones(5000)], axis=-1)
    pixels, valid, d_pixels_d_point, _ = camera.project_with_jacobians(points)
    assert valid.all()
    assert (np.linalg.det(d_pixels_d_point[..., :2]) > 0.0).all()
    rays, seen = camera.unproject(pixels)
    assert seen.all()
    assert np.abs(rays / rays[:, 2:] - points).max() < ROUND_TRIP_RAY


def test_radial_fold_is_where_the_radius_turns_back() -> None:
    """k1 alone: r (1 + k1 r^2) turns at r = 1 / sqrt(-3 k1), by hand."""
    camera = _brown(-0.3, 0.0, 0.0, 0.0, 0.0)
    assert camera.max_angle_rad == pytest.approx(np.arctan(1.0 / np.sqrt(0.9)), abs=1e-12)


def test_pixels_beyond_the_fold_have_no_ray() -> None:
    camera = _brown(-0.3, 0.0, 0.0, 0.0, 0.0)
    largest = 800.0 * (1.0 / np.sqrt(0.9)) * (1.0 - 0.3 / 0.9)
    _, valid = camera.unproject(np.array([[640.0 + 0.999 * largest, 480.0], [640.0 + 1.001 * largest, 480.0]]))
    assert valid.tolist() == [True, False]


def test_field_of_view_ends_where_the_denominator_vanishes() -> None:
    camera = _brown(0.0, 0.0, 0.0, 0.0, 0.0, -0.5, 0.0, 0.0)
    assert np.tan(camera.max_angle_rad) <= np.sqrt(2.0)


def test_a_pole_at_the_edge_does_not_change_the_middle() -> None:
    """Found by a calibration: rounding puts the last tangent tried just beyond the pole of the denominator, where the
    radius is minus infinity."""
    distortion = (-0.21704038890666294, -0.04974512324895835, 0.0004146353136183291, -0.00023144410004960334)
    rational = (-0.04488481845697748, -0.024700984939316398, -0.17197159475241827, -0.06265940416793397)
    focal_and_centre = (1363.6642418578524, 1364.6908712673348, 808.3415937044739, 615.260008997579)
    camera = Brown((1624, 1240), np.array([*focal_and_centre, *distortion, *rational]))
    u, v = np.meshgrid(np.linspace(0.0, 1623.0, 40), np.linspace(0.0, 1239.0, 30))
    pixels = np.stack([u, v], axis=-1)
    rays, valid = camera.unproject(pixels)
    assert valid.all()
    assert camera.project(rays)[0] == pytest.approx(pixels, abs=1e-6)
