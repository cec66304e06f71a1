"""The camera of points in mm: rays start at the entrance pupil of their own angle."""

from __future__ import annotations

import numpy as np
import pytest
from helpers.cameras import sample_cameras

from rigkit.cameras.base import Camera
from rigkit.cameras.board_pose import board_with_fixed_pupil, cam_from_seen_board
from rigkit.cameras.moving_pupil import NearCamera, far_camera, pupil_shift_of_rays_mm
from rigkit.core.arrays import FloatArray
from rigkit.core.boards import Board
from rigkit.geometry.rigid3 import Rigid3
from rigkit.geometry.rotation import exp_so3

PUPIL = np.array([3.0, -0.4])
WIDE = ("kannala_brandt", "scaramuzza", "ucm", "double_sphere")


def points_before(camera: Camera, rng: np.random.Generator) -> FloatArray:
    """Return points 60 to 400 mm away, up to 80 degrees off the axis, and one on it."""
    angle, about = np.radians(80.0) * rng.random(200), rng.uniform(-np.pi, np.pi, 200)
    along = np.stack([np.sin(angle) * np.cos(about), np.sin(angle) * np.sin(about), np.cos(angle)], axis=1)
    return np.concatenate([along * rng.uniform(60.0, 400.0, (200, 1)), [[0.0, 0.0, 100.0]]])


@pytest.mark.parametrize("name", WIDE)
def test_a_point_lies_on_the_ray_of_its_pixel_which_starts_at_the_pupil(name: str, rng: np.random.Generator) -> None:
    near = NearCamera.of(sample_cameras()[name], PUPIL)
    points = points_before(near, rng)
    pixels, valid = near.project(points)
    assert valid.all()
    rays = near.unproject(pixels)[0]
    starts = np.zeros_like(points)
    starts[:, 2] = pupil_shift_of_rays_mm(rays, PUPIL)
    assert np.abs(starts[:-1, 2]).max() > 3.0
    along = points - starts
    np.testing.assert_allclose(along / np.linalg.norm(along, axis=1, keepdims=True), rays, atol=1e-10)
    np.testing.assert_allclose(near.lens.project(near.seen(points))[0], pixels, atol=1e-9)


@pytest.mark.parametrize("name", WIDE)
def test_derivatives_are_those_of_the_projection(name: str, rng: np.random.Generator) -> None:
    near = NearCamera.of(sample_cameras()[name], PUPIL)
    points = points_before(near, rng)
    _, _, d_pixels_d_point, d_pixels_d_parameters = near.project_with_jacobians(points)
    for k in range(3):
        step = 1e-4 * np.eye(3)[k]
        found = (near.project(points + step)[0] - near.project(points - step)[0]) / 2e-4
        np.testing.assert_allclose(d_pixels_d_point[..., k], found, atol=1e-6 * np.abs(d_pixels_d_point).max())
    for k in (-2, -1):
        step = np.zeros(near.parameters.size)
        step[k] = 1e-4
        more, less = (near.with_parameters(near.parameters + sign * step) for sign in (1.0, -1.0))
        found = (more.project(points)[0] - less.project(points)[0]) / 2e-4
        np.testing.assert_allclose(d_pixels_d_parameters[..., k], found, atol=1e-6 * np.abs(found).max())


def test_far_away_it_is_the_lens(rng: np.random.Generator) -> None:
    lens = sample_cameras()["kannala_brandt"]
    near = NearCamera.of(lens, PUPIL)
    points = 1e9 * points_before(near, rng)
    np.testing.assert_allclose(near.project(points)[0], lens.project(points)[0], atol=1e-5)
    pixels = np.array([[100.0, 50.0], [648.0, 467.0], [1200.0, 900.0]])
    np.testing.assert_array_equal(near.ray_jacobian(pixels), lens.ray_jacobian(pixels))
    assert near.focal_px == lens.focal_px and (near.axis_px == lens.axis_px).all()
    assert far_camera(near) is lens and far_camera(lens) is lens


def test_a_point_on_several_rays_is_invalid() -> None:
    near = NearCamera.of(sample_cameras()["kannala_brandt"], PUPIL)
    points = np.array([[2.0, 0.0, 3.0], [np.nan, 0.0, 1.0], [40.0, 0.0, 40.0]])
    assert near.project(points)[1].tolist() == [False, False, True]
    assert not np.isfinite(near.seen(points)[0]).any()


def test_the_board_pose_accounts_for_the_moving_pupil() -> None:
    near = NearCamera.of(sample_cameras()["kannala_brandt"], PUPIL)
    board = Board("near", 7, 5, 15.0, 15.0)
    pose = Rigid3(exp_so3(np.array([0.3, 1.0, 0.2])), np.array([90.0, -30.0, 90.0]))
    pixels, valid = near.project(pose.apply(board.points()))
    assert valid.all()
    found = cam_from_seen_board(near, pixels, board.points())
    np.testing.assert_allclose(found.translation_mm, pose.translation_mm, atol=1e-5)
    np.testing.assert_allclose(found.rotation, pose.rotation, atol=1e-7)
    central = cam_from_seen_board(near.lens, pixels, board.points())
    assert np.linalg.norm(central.translation_mm - pose.translation_mm) > 1.0
    fixed_pupil = board_with_fixed_pupil(near, pixels, board.points())
    np.testing.assert_allclose(fixed_pupil, near.lens.project(pose.apply(board.points()))[0], atol=1e-5)
