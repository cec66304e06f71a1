"""Camera models against OpenCV's and COLMAP's implementations."""

from __future__ import annotations

import cv2
import numpy as np
import pycolmap
import pytest
from helpers.cameras import rays_within, sample_cameras

from rigkit.cameras.base import Camera
from rigkit.cameras.registry import camera_model

CAMERAS = sample_cameras()
AGREE_DOUBLE_PX = 1e-9
"""OpenCV and COLMAP project in double precision: only rounding is left."""
AGREE_RAY = 1e-8
"""Their inverses iterate to about 1e-9."""
NO_MOTION = (np.zeros(3), np.zeros(3))


def _points(camera: Camera, below_deg: float, rng: np.random.Generator) -> np.ndarray:
    reach = min(0.97 * camera.max_angle_rad, np.radians(below_deg))
    return rays_within(reach, 700, rng) * rng.uniform(200.0, 3000.0, (700, 1))


@pytest.mark.parametrize("label", ["pinhole", "brown", "brown_rational"])
def test_project_points(label: str, rng: np.random.Generator) -> None:
    camera = CAMERAS[label]
    points = _points(camera, 75.0, rng)
    p = camera.parameters
    K = np.array([[p[0], 0.0, p[2]], [0.0, p[1], p[3]], [0.0, 0.0, 1.0]])
    distortion = p[4:] if p.size > 4 else np.zeros(5)
    theirs = cv2.projectPoints(points, *NO_MOTION, K, distortion)[0][:, 0]
    ours, valid = camera.project(points)
    assert valid.all()
    assert np.abs(ours - theirs).max() < AGREE_DOUBLE_PX


@pytest.mark.parametrize("label", ["kannala_brandt", "kannala_brandt_folding"])
def test_fisheye_project_points(label: str, rng: np.random.Generator) -> None:
    """Below 90 degrees, where OpenCV's fisheye is right."""
    camera = CAMERAS[label]
    points = _points(camera, 89.0, rng)
    p = camera.parameters
    K = np.array([[p[0], 0.0, p[2]], [0.0, p[1], p[3]], [0.0, 0.0, 1.0]])
    theirs = cv2.fisheye.projectPoints(points[:, None], *NO_MOTION, K, p[4:])[0][:, 0]
    ours, valid = camera.project(points)
    assert valid.all()
    assert np.abs(ours - theirs).max() < AGREE_DOUBLE_PX


@pytest.mark.parametrize("label", ["ucm", "ucm_narrow"])
def test_omnidir_project_points(label: str, rng: np.random.Generator) -> None:
    """OpenCV's omnidir without distortion is the unified camera: xi = alpha / (1 - alpha), gamma = f (1 + xi)."""
    camera = CAMERAS[label]
    points = _points(camera, 179.0, rng)
    p = camera.parameters
    xi = p[4] / (1.0 - p[4])
    K = np.array([[p[0] * (1.0 + xi), 0.0, p[2]], [0.0, p[1] * (1.0 + xi), p[3]], [0.0, 0.0, 1.0]])
    theirs = cv2.omnidir.projectPoints(points[None], *NO_MOTION, K, xi, np.zeros(4))[0][0]
    ours, valid = camera.project(points)
    assert valid.all()
    assert np.abs(ours - theirs).max() < AGREE_DOUBLE_PX


@pytest.mark.parametrize(
    ("label", "theirs"),
    [
        ("pinhole", "PINHOLE"),
        ("brown_rational", "FULL_OPENCV"),
        ("kannala_brandt", "OPENCV_FISHEYE"),
        ("eucm", "EUCM"),
    ],
)
def test_colmap(label: str, theirs: str, rng: np.random.Generator) -> None:
    """COLMAP, whose first pixel has its centre at (0.5, 0.5), sees only z > 0 in all of these."""
    camera = CAMERAS[label]
    points = _points(camera, 80.0, rng)
    colmap = pycolmap.Camera(
        model=theirs, width=camera.size_px[0], height=camera.size_px[1], params=camera.parameters.copy()
    )
    ours, valid = camera.project(points)
    assert valid.all()
    assert np.abs(ours - colmap.img_from_cam(points)).max() < AGREE_DOUBLE_PX
    rays, seen = camera.unproject(ours)
    assert seen.all()
    assert np.abs(rays - np.asarray(colmap.cam_ray_from_img(ours))).max() < AGREE_RAY


def test_shortest_polynomial_is_the_unified_parabola(rng: np.random.Generator) -> None:
    """Scaramuzza with f = a0 + a2 rho^2, a2 = -1 / (4 a0), is the parabolic mirror: the unified camera at alpha = 1/2.

    There rho = r / ((|X| + z) / 2) a0, in closed form and to the full 180 degrees.
    """
    a0 = 300.0
    unified = camera_model("ucm")((1280, 960), np.array([a0, a0, 640.0, 480.0, 0.5]))
    polynomial = camera_model("scaramuzza")((1280, 960), np.array([a0, -0.25 / a0, 0.0, 640.0, 480.0, 1.0, 0.0]))
    points = rays_within(np.radians(120.0), 500, rng) * 700.0
    a, valid = polynomial.project(points)
    b, seen = unified.project(points)
    assert valid.all() and seen.all()
    assert np.abs(a - b).max() < AGREE_DOUBLE_PX


def test_kannala_brandt_beyond_90_degrees() -> None:
    """By hand: without distortion the radius is f theta, also behind the camera where OpenCV mirrors the image."""
    camera = camera_model("kannala_brandt")((1280, 960), np.array([300.0, 300.0, 640.0, 480.0, 0.0, 0.0, 0.0, 0.0]))
    theta = np.radians([10.0, 90.0, 100.0, 140.0, 179.0])
    pixels, valid = camera.project(np.stack([np.sin(theta), 0.0 * theta, np.cos(theta)], axis=-1))
    assert valid.all()
    assert np.abs(pixels[:, 0] - 640.0 - 300.0 * theta).max() < AGREE_DOUBLE_PX
