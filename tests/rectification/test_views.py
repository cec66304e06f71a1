"""Virtual views cover what they must, at the source's own resolution, and refuse what no perspective image shows."""

from __future__ import annotations

import numpy as np
import pytest
from helpers.cameras import rays_within, sample_cameras

from rigkit.cameras.pinhole import Pinhole
from rigkit.core.errors import DegenerateError, InputError
from rigkit.geometry.rotation import exp_so3
from rigkit.rectification.views import perspective_view, smallest_cone

FISHEYE = sample_cameras()["kannala_brandt"]
CONE_REL = 0.02
"""The iteration promises 1 part in 200 of the angle; the sampled cone itself misses its edge by as much again."""


def _turned(half_angle_deg: float, yaw_deg: float, rng: np.random.Generator) -> np.ndarray:
    return rays_within(np.radians(half_angle_deg), 400, rng) @ exp_so3(np.array([0.0, np.radians(yaw_deg), 0.0])).T


@pytest.mark.parametrize("yaw_deg", [0.0, 50.0, 85.0])
def test_view_covers_the_rays(yaw_deg: float, rng: np.random.Generator) -> None:
    rays = _turned(20.0, yaw_deg, rng)
    view, target_from_cam = perspective_view(np.append(rays, np.full((1, 3), np.nan), axis=0), FISHEYE)
    pixels, valid = view.project(rays @ target_from_cam.T)
    assert valid.all()
    assert view.on_image(pixels).all()
    spread = pixels.max(axis=0) - pixels.min(axis=0)
    assert (spread > 0.85 * np.array(view.size_px)).all()
    assert np.abs(target_from_cam @ target_from_cam.T - np.eye(3)).max() < 1e-12


def test_view_has_the_resolution_of_the_source(rng: np.random.Generator) -> None:
    rays = _turned(4.0, 60.0, rng)
    view, target_from_cam = perspective_view(rays, FISHEYE)
    source, target = FISHEYE.project(rays)[0], view.project(rays @ target_from_cam.T)[0]
    area = [np.prod(np.linalg.svd(p - p.mean(axis=0), compute_uv=False)[:2]) for p in (source, target)]
    assert area[1] == pytest.approx(area[0], rel=0.05)
    double, _ = perspective_view(rays, FISHEYE, focal_scale=2.0)
    assert double.focal_px == pytest.approx(2.0 * view.focal_px, rel=1e-9)


def test_view_of_a_perspective_image_keeps_its_focal_length(rng: np.random.Generator) -> None:
    """Also far off the axis, where a pinhole itself has more pixels per radian."""
    source = Pinhole((2000, 2000), np.array([500.0, 500.0, 999.5, 999.5]))
    view, _ = perspective_view(rays_within(np.radians(55.0), 400, rng), source)
    assert view.focal_px == pytest.approx(500.0, rel=0.01)


def test_smallest_cone(rng: np.random.Generator) -> None:
    """Most rays on one side must not pull the axis there, as their mean would."""
    rays = _turned(30.0, 40.0, rng)
    crowd = _turned(3.0, 65.0, rng)
    axis, half_angle = smallest_cone(np.concatenate([rays, crowd, crowd, crowd]))
    assert half_angle == pytest.approx(np.radians(30.0), rel=CONE_REL)
    assert axis @ [np.sin(np.radians(40.0)), 0.0, np.cos(np.radians(40.0))] > np.cos(np.radians(1.0))


def test_wide_sets_of_rays_are_refused(rng: np.random.Generator) -> None:
    with pytest.raises(DegenerateError, match=r"span 1[56]\d degrees"):
        perspective_view(_turned(76.0, 0.0, rng), FISHEYE)
    perspective_view(_turned(73.0, 0.0, rng), FISHEYE)
    with pytest.raises(DegenerateError, match="all around"):
        perspective_view(np.array([[1.0, 0.0, 0.0], [-1.0, 0.0, 0.0]]), FISHEYE)
    with pytest.raises(InputError, match="no ray"):
        perspective_view(np.full((3, 3), np.nan), FISHEYE)


def test_view_straight_back(rng: np.random.Generator) -> None:
    rays = rays_within(0.2, 50, rng) * [1.0, -1.0, -1.0]
    camera = sample_cameras()["kannala_brandt"].with_parameters([300.0, 300.0, 640.0, 480.0, 0.0, 0.0, 0.0, 0.0])
    view, target_from_cam = perspective_view(rays, camera)
    assert view.project(rays @ target_from_cam.T)[1].all()
