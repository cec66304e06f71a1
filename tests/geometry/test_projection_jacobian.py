"""d pixel / d point from rays and ray Jacobians alone, against the camera's own derivative, for every model."""

from __future__ import annotations

import numpy as np
import pytest
from helpers.cameras import image_pixels, sample_cameras
from helpers.differences import central_difference
from helpers.tolerances import JACOBIAN_REL

from rigkit.cameras.base import Camera
from rigkit.geometry.projection_jacobian import pair_projection_jacobians, projection_jacobian
from rigkit.geometry.rigid3 import Rigid3
from rigkit.geometry.rotation import exp_so3


@pytest.mark.parametrize("label", sorted(sample_cameras()))
def test_equals_the_derivative_of_project(label: str, rng: np.random.Generator) -> None:
    camera = sample_cameras()[label]
    pixels = image_pixels(camera, 11, 9)
    rays, valid = camera.unproject(pixels)
    rays, pixels = rays[valid], pixels[valid]
    assert len(rays) > 20
    ranges = rng.uniform(500.0, 2000.0, len(rays))
    jacobians = projection_jacobian(rays, camera.ray_jacobian(pixels), ranges)
    _, seen, d_pixels_d_point, _ = camera.project_with_jacobians(rays * ranges[:, None])
    assert seen.mean() > 0.9
    scale = np.abs(d_pixels_d_point[seen]).max(axis=(1, 2), keepdims=True)
    np.testing.assert_allclose((jacobians[seen] - d_pixels_d_point[seen]) / scale, 0.0, atol=JACOBIAN_REL)


def test_second_camera_is_differentiated_in_the_frame_of_the_first(rng: np.random.Generator) -> None:
    camera: Camera = sample_cameras()["kannala_brandt"]
    pose = Rigid3(exp_so3(np.array([0.1, -0.3, 0.2])), [-200.0, 30.0, 80.0])
    points = rng.uniform([-600, -400, 500], [600, 400, 1500], (40, 3))
    (q1, _), (q2, _) = camera.project(points), camera.project(pose.apply(points))
    (f1, _), (f2, _) = camera.unproject(q1), camera.unproject(q2)
    J1, J2 = pair_projection_jacobians(points, f1, camera.ray_jacobian(q1), f2, camera.ray_jacobian(q2), pose)
    one = central_difference(lambda x: camera.project(x)[0], points)
    two = central_difference(lambda x: camera.project(pose.apply(x))[0], points)
    for J, numeric in ((J1, one), (J2, two)):
        np.testing.assert_allclose(J, numeric, atol=JACOBIAN_REL * np.abs(numeric).max())


def test_degenerate_input_is_nan() -> None:
    rays, jacobians = np.array([[0.0, 0.0, 1.0]] * 2), np.zeros((2, 3, 2))
    jacobians[0, 0, 0] = jacobians[0, 1, 1] = 1e-3
    assert np.isnan(projection_jacobian(rays, jacobians, np.array([0.0, 1.0]))).any(axis=(1, 2)).all()
