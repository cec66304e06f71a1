"""Rectification: points and Jacobians exactly, images to the accuracy of resampling a picture known in closed form."""

from __future__ import annotations

import numpy as np
import pytest
from helpers.cameras import image_pixels, rays_within, sample_cameras
from helpers.differences import central_difference
from helpers.tolerances import JACOBIAN_REL, ROUND_TRIP_PX

from rigkit.cameras.base import Camera, RadialCurve
from rigkit.cameras.pinhole import Pinhole
from rigkit.cameras.registry import camera_model
from rigkit.core.errors import InputError
from rigkit.geometry.rotation import exp_so3
from rigkit.rectification.panorama import (
    Cylindrical,
    EpipolarCylindrical,
    EpipolarEquirectangular,
    Equirectangular,
    Panorama,
)
from rigkit.rectification.rectify import _Sampler, rectify_map, rotation_from_view_angles

FISHEYE = sample_cameras()["kannala_brandt"]
PANORAMAS: dict[str, Panorama] = {
    cls.model: cls((801, 401), np.array([120.0, 118.0, 400.0, 200.0]))
    for cls in (Cylindrical, EpipolarCylindrical, Equirectangular, EpipolarEquirectangular)
}
TARGETS: dict[str, Camera] = {
    **PANORAMAS,
    "pinhole": Pinhole((640, 480), np.array([300.0, 300.0, 319.5, 239.5])),
    "ucm": camera_model("ucm")((640, 480), np.array([190.0, 190.0, 319.5, 239.5, 0.6])),
}
SPLINE_GREY = 0.25
"""Of 255, half a grey level lost in rounding and 0.02 by the spline at 12 px a wave; linear interpolation is 10 off."""


@pytest.mark.parametrize("name", sorted(PANORAMAS))
def test_panoramas_by_their_formulas(name: str, rng: np.random.Generator) -> None:
    camera = PANORAMAS[name]
    rays = rng.normal(size=(500, 3))
    rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
    x, y, z = rays.T
    expected = {
        "cylindrical": (np.arctan2(x, z), y / np.hypot(x, z)),
        "equirectangular": (np.arctan2(x, z), np.arcsin(y)),
        "epipolar_cylindrical": (x / np.hypot(y, z), np.arctan2(y, z)),
        "epipolar_equirectangular": (np.arcsin(x), np.arctan2(y, z)),
    }[name]
    pixels, valid = camera.project(3.0 * rays)
    assert valid.all()
    assert np.abs(pixels - np.stack(expected, axis=-1) * [120.0, 118.0] - [400.0, 200.0]).max() < 1e-7
    again, seen = camera.unproject(pixels)
    assert seen.all()
    assert np.abs(again - rays).max() < 1e-10
    inner = np.abs(rays[:, :2]).max(axis=-1) < 0.95
    assert inner.mean() > 0.7
    _, _, d_pixels_d_point, d_pixels_d_parameters = camera.project_with_jacobians(rays[inner])
    numeric = central_difference(lambda p: camera.project(p)[0], rays[inner], 1e-6)
    assert np.abs(d_pixels_d_point - numeric).max() < JACOBIAN_REL * np.abs(numeric).max()
    numeric = np.stack(
        [
            (camera.with_parameters(camera.parameters + h).project(rays[inner])[0] - pixels[inner]) / h.sum()
            for h in np.eye(4)
        ],
        axis=-1,
    )
    assert np.abs(d_pixels_d_parameters - numeric).max() < JACOBIAN_REL
    jacobian = camera.ray_jacobian(pixels[inner])
    assert np.abs(d_pixels_d_point @ jacobian - np.eye(2)).max() < ROUND_TRIP_PX


@pytest.mark.parametrize("name", sorted(PANORAMAS))
def test_panoramas_refuse_what_they_do_not_show(name: str) -> None:
    camera = PANORAMAS[name]
    pole = np.array([1.0, 0.0, 0.0]) if "epipolar" in name else np.array([0.0, 1.0, 0.0])
    assert not camera.project(np.stack([pole, np.full(3, np.nan), np.zeros(3)]))[1].any()
    axis = 1 if "epipolar" in name else 0
    pixel = np.array([400.0, 200.0])
    pixel[axis] += 118.0 * 3.3
    assert not camera.unproject(pixel)[1]
    with pytest.raises(InputError, match="camera starts at a radial curve"):
        curve = RadialCurve(np.array([5.0, 5.0]), np.array([0.1, 0.2, 0.3, 0.4]), np.array([1.0, 2.0, 3.0, 4.0]))
        type(camera).from_radial_curve((10, 10), curve)


@pytest.mark.parametrize("name", sorted(TARGETS))
def test_points_go_there_and_back(name: str, rng: np.random.Generator) -> None:
    remap = rectify_map(FISHEYE, TARGETS[name], target_from_cam=exp_so3(np.array([0.2, -0.4, 0.1])))
    pixels = image_pixels(FISHEYE)
    there, valid = remap.pixels(pixels)
    assert valid.mean() > (0.5 if name == "pinhole" else 0.9)
    back, seen = remap.source_pixels(there[valid])
    assert seen.all()
    assert np.abs(back - pixels[valid]).max() < 1e-6
    # A point in space seen by either camera: the definition of the map.
    points = rays_within(np.radians(55.0), 300, rng) * rng.uniform(100.0, 900.0, (300, 1))
    source, _ = FISHEYE.project(points)
    target, _ = TARGETS[name].project(points @ remap.target_from_cam.T)
    assert np.nanmax(np.abs(remap.pixels(source)[0] - target)) < 1e-6


@pytest.mark.parametrize("name", sorted(TARGETS))
def test_jacobians(name: str) -> None:
    remap = rectify_map(FISHEYE, TARGETS[name], target_from_cam=exp_so3(np.array([0.2, -0.4, 0.1])))
    pixels = image_pixels(FISHEYE)
    there, valid = remap.pixels(pixels)
    inside = valid & TARGETS[name].on_image(there)
    assert inside.sum() > 100
    analytic = remap.jacobians(pixels[inside])
    numeric = central_difference(lambda q: remap.pixels(q)[0], pixels[inside], 1e-3)
    good = np.abs(numeric).max(axis=(-1, -2)) < 50.0
    assert good.mean() > 0.9
    error = np.abs(analytic - numeric)[good] / np.abs(numeric[good]).max(axis=(-1, -2), keepdims=True)
    assert error.max() < 10.0 * JACOBIAN_REL
    assert np.abs(remap.scale(pixels[inside]) ** 2 - np.abs(np.linalg.det(analytic))).max() < 1e-9


def test_view_angles_turn_right_up_and_clockwise() -> None:
    """The viewing direction in the camera's frame is the third row of target_from_cam."""
    right = rotation_from_view_angles(np.radians(30.0), 0.0)
    assert right[2] == pytest.approx([0.5, 0.0, np.sqrt(0.75)])
    up = rotation_from_view_angles(0.0, np.radians(30.0))
    assert up[2] == pytest.approx([0.0, -0.5, np.sqrt(0.75)])
    clockwise = rotation_from_view_angles(0.0, 0.0, np.radians(90.0))
    assert clockwise[0] == pytest.approx([0.0, 1.0, 0.0], abs=1e-12)


def _waves(rays: np.ndarray) -> np.ndarray:
    """A picture painted on the sphere: smooth enough for a few pixels a wave."""
    return 127.5 + 60.0 * np.sin(31.0 * rays[..., 0] + 7.0 * rays[..., 2]) + 60.0 * np.cos(29.0 * rays[..., 1])


def _painted(camera: Camera) -> np.ndarray:
    columns, rows = camera.size_px
    grid = np.stack(np.meshgrid(np.arange(columns), np.arange(rows)), axis=-1).astype(float)
    rays, valid = camera.unproject(grid)
    return np.where(valid, _waves(np.where(valid[..., None], rays, 0.0)), 0.0)


@pytest.mark.parametrize("name", sorted(TARGETS))
def test_image_is_the_picture_that_the_target_would_take(name: str) -> None:
    rotation = exp_so3(np.array([0.1, -0.2, 0.05]))
    source = camera_model("kannala_brandt")((640, 480), np.array([190.0, 189.0, 324.0, 233.0, -0.02, 0.004, 0.0, 0.0]))
    remap = rectify_map(source, TARGETS[name], target_from_cam=rotation)
    out = remap.image(_painted(source), antialias=False, fill=np.nan)
    seen = np.isfinite(out)
    assert seen.mean() > 0.25
    columns, rows = remap.target.size_px
    grid = np.stack(np.meshgrid(np.arange(columns), np.arange(rows)), axis=-1).astype(float)
    rays, _ = remap.target.unproject(grid[seen])
    error = np.abs(out[seen] - _waves(rays @ rotation))
    # The outermost pixel of the source is continued, not known.
    where, _ = remap.source_pixels(grid[seen])
    inner = (where > 3.0).all(axis=-1) & (where < np.array(source.size_px) - 4.0).all(axis=-1)
    assert inner.mean() > 0.9
    assert np.quantile(error[inner], 0.99) < SPLINE_GREY
    assert np.array_equal(seen, remap.coverage())


def test_dtype_channels_and_size() -> None:
    source = camera_model("kannala_brandt")((64, 48), np.array([19.0, 19.0, 31.5, 23.5, 0.0, 0.0, 0.0, 0.0]))
    remap = rectify_map(source, Pinhole((40, 30), np.array([20.0, 20.0, 19.5, 14.5])))
    grey = np.full((48, 64), 200, dtype=np.uint8)
    for interpolation in ("spline", "lanczos", "linear", "nearest"):
        assert (remap.image(grey, interpolation=interpolation) == 200).all()
    colour = np.stack([grey, grey // 2, grey // 4], axis=-1).astype(np.uint16) * 100
    out = remap.image(colour)
    assert out.dtype == np.uint16
    assert out.shape == (30, 40, 3)
    assert (out == [20000, 10000, 5000]).all()
    with pytest.raises(InputError, match="64 x 48"):
        remap.image(np.zeros((64, 48)))
    with pytest.raises(InputError, match="unknown"):
        remap.image(grey, interpolation="cubic")  # type: ignore[arg-type]
    with pytest.raises(InputError, match="rotation"):
        rectify_map(source, source, target_from_cam=2.0 * np.eye(3))


def test_antialias_averages_what_a_small_target_shows(rng: np.random.Generator) -> None:
    """Noise shown 6 times smaller must lose most of its spread; without antialiasing it keeps it all."""
    source = Pinhole((600, 600), np.array([600.0, 600.0, 299.5, 299.5]))
    target = Pinhole((100, 100), np.array([100.0, 100.0, 49.5, 49.5]))
    noise = rng.normal(size=(600, 600))
    remap = rectify_map(source, target)
    assert remap.image(noise).std() < 0.3
    assert remap.image(noise, antialias=False).std() > 0.6


def test_an_image_by_its_spline_is_the_image_where_its_pixels_are(rng: np.random.Generator) -> None:
    """And cubic between them: a parabola comes back from its samples, away from the border."""
    image = rng.integers(0, 255, (9, 11)).astype(np.uint8)
    v, u = np.mgrid[:9, :11].astype(np.float64)
    here = np.stack([u.ravel(), v.ravel()], axis=-1)
    assert np.allclose(_Sampler(image, "spline")(here), image.ravel(), atol=1e-9)
    assert _Sampler(np.zeros((9, 11, 3), np.uint8), "spline")(np.empty((0, 2))).shape == (0, 3)
    line = (10.0 + 3.0 * v - 2.0 * u).astype(np.float64)
    between = np.array([[5.25, 4.5], [5.5, 3.75]])
    # The border mirrors the picture, whose slope ends there: a tenth of it is left three pixels away.
    assert np.allclose(_Sampler(line, "spline")(between), 10.0 + 3.0 * between[:, 1] - 2.0 * between[:, 0], atol=0.1)
