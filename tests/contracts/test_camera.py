"""What every camera model must do, run for each model of the registry with every parameter non-trivial."""

from __future__ import annotations

import numpy as np
import pytest
from helpers.cameras import image_pixels, rays_within, sample_cameras
from helpers.differences import central_difference
from helpers.tolerances import JACOBIAN_REL, ROUND_TRIP_PX

from rigkit.cameras.base import Camera, RadialCurve
from rigkit.cameras.pinhole import Pinhole
from rigkit.cameras.registry import MODELS
from rigkit.core.errors import InputError

CAMERAS = sample_cameras()
VALID_SHARE = 0.9
"""At least this share of the sampled pixels must be valid, so that nothing passes because nothing was looked at."""
ROUND_TRIP_RAY = 1e-10
"""The same on the unit sphere, away from the edge where the radius stops growing."""
CURVE_PX = 1e-5
"""Every model contains its own curve; the least squares are good to 1e-7 px (rational Brown, the worst conditioned)."""
EDGE = 1e-3
"""Just inside and just outside of the field of view, as shares of its angle."""
INSIDE = 0.99
"""Rays are taken to this share of the field of view: at the edge itself d pixel / d angle may vanish or be infinite."""


@pytest.fixture(params=sorted(CAMERAS), name="camera")
def _camera(request: pytest.FixtureRequest) -> Camera:
    return CAMERAS[request.param]


def _field(camera: Camera) -> float:
    """Angle out to which rays are tested: perspective images run to infinity at 90 degrees."""
    perspective = camera.model in ("pinhole", "brown")
    return min(INSIDE * camera.max_angle_rad, np.radians(80.0) if perspective else np.pi)


def _valid_pixels(camera: Camera) -> np.ndarray:
    pixels = image_pixels(camera)
    _, valid = camera.unproject(pixels)
    assert valid.mean() >= VALID_SHARE
    return pixels[valid]


def test_registry_is_covered() -> None:
    assert {camera.model for camera in CAMERAS.values()} == set(MODELS)
    assert all(cls.model == name for name, cls in MODELS.items())


def test_pixel_to_ray_to_pixel(camera: Camera) -> None:
    pixels = _valid_pixels(camera)
    rays, valid = camera.unproject(pixels)
    assert valid.all()
    for depth in (1e-3, 1.0, 4e5):
        again, seen = camera.project(depth * rays)
        assert seen.mean() >= VALID_SHARE
        assert np.abs(again - pixels)[seen].max() < ROUND_TRIP_PX


def test_ray_to_pixel_to_ray(camera: Camera, rng: np.random.Generator) -> None:
    rays = rays_within(_field(camera), 1500, rng)
    for depth in (0.5, 1.0, 2e4):
        pixels, valid = camera.project(depth * rays)
        assert valid.all()
        again, seen = camera.unproject(pixels)
        assert seen.all()
        assert np.abs(again - rays).max() < ROUND_TRIP_RAY


def test_rays_are_unit_and_float64(camera: Camera) -> None:
    rays, _ = camera.unproject(_valid_pixels(camera))
    assert rays.dtype == np.float64
    assert np.abs(np.linalg.norm(rays, axis=-1) - 1.0).max() < 1e-14


def test_axis_meets_the_principal_point(camera: Camera) -> None:
    names = camera.parameter_names()
    principal = camera.parameters[[names.index("cx"), names.index("cy")]]
    pixel, valid = camera.project(np.array([0.0, 0.0, 7.0]))
    assert valid
    assert np.abs(pixel - principal).max() < ROUND_TRIP_PX
    ray, _ = camera.unproject(principal)
    assert np.abs(ray - [0.0, 0.0, 1.0]).max() < ROUND_TRIP_RAY


def test_image_is_not_mirrored(camera: Camera) -> None:
    right, _ = camera.project(np.array([0.1, 0.0, 1.0]))
    down, _ = camera.project(np.array([0.0, 0.1, 1.0]))
    centre, _ = camera.project(np.array([0.0, 0.0, 1.0]))
    assert right[0] > centre[0]
    assert down[1] > centre[1]


def test_jacobian_by_point(camera: Camera, rng: np.random.Generator) -> None:
    points = rays_within(_field(camera), 400, rng) * rng.uniform(0.3, 3.0, (400, 1))
    pixels, valid, d_pixels_d_point, _ = camera.project_with_jacobians(points)
    assert valid.all()
    assert np.abs(pixels - camera.project(points)[0]).max() < ROUND_TRIP_PX
    numeric = central_difference(lambda p: camera.project(p)[0], points, 1e-6)
    scale = np.abs(numeric).max(axis=(-1, -2), keepdims=True)
    checked = np.isfinite(numeric).all(axis=(-1, -2))
    assert checked.mean() >= VALID_SHARE
    assert (np.abs(d_pixels_d_point - numeric) / scale)[checked].max() < JACOBIAN_REL


def test_jacobian_by_parameters(camera: Camera, rng: np.random.Generator) -> None:
    points = rays_within(_field(camera), 400, rng) * rng.uniform(0.3, 3.0, (400, 1))
    _, valid, _, d_pixels_d_parameters = camera.project_with_jacobians(points)
    assert valid.all()
    assert d_pixels_d_parameters.shape == (400, 2, camera.parameters.size)
    for k, name in enumerate(camera.parameter_names()):
        # A step that moves the pixels by about 1e-3 px, whatever the unit of the parameter is.
        h = 1e-3 / np.abs(d_pixels_d_parameters[..., k]).max()
        up, down = camera.parameters.copy(), camera.parameters.copy()
        up[k] += h
        down[k] -= h
        numeric = (camera.with_parameters(up).project(points)[0] - camera.with_parameters(down).project(points)[0]) / (
            up[k] - down[k]
        )
        checked = np.isfinite(numeric).all(axis=-1)
        assert checked.mean() >= VALID_SHARE, name
        error = np.abs(d_pixels_d_parameters[..., k] - numeric)[checked].max() / np.abs(numeric[checked]).max()
        assert error < JACOBIAN_REL, name


def test_ray_jacobian(camera: Camera) -> None:
    pixels = _valid_pixels(camera)
    rays, _ = camera.unproject(pixels)
    # Away from the edge of the field of view, where the derivative of the inverse may be infinite.
    inner = np.arctan2(np.hypot(rays[:, 0], rays[:, 1]), rays[:, 2]) < 0.95 * camera.max_angle_rad
    assert inner.mean() >= VALID_SHARE
    pixels, rays = pixels[inner], rays[inner]
    jacobian = camera.ray_jacobian(pixels)
    assert jacobian.shape == (*pixels.shape[:-1], 3, 2)
    numeric = central_difference(lambda q: camera.unproject(q)[0], pixels, 1e-3)
    scale = np.abs(numeric).max(axis=(-1, -2), keepdims=True)
    assert (np.abs(jacobian - numeric) / scale).max() < JACOBIAN_REL
    assert np.abs(np.einsum("ni,nij->nj", rays, jacobian)).max() < ROUND_TRIP_RAY


def test_projection_and_ray_jacobian_are_inverse(camera: Camera) -> None:
    pixels = _valid_pixels(camera)
    rays, _ = camera.unproject(pixels)
    _, valid, d_pixels_d_point, _ = camera.project_with_jacobians(rays)
    product = d_pixels_d_point @ camera.ray_jacobian(pixels)
    assert valid.mean() >= VALID_SHARE
    inner = np.arctan2(np.hypot(rays[:, 0], rays[:, 1]), rays[:, 2]) < 0.95 * camera.max_angle_rad
    assert np.abs(product - np.eye(2))[valid & inner].max() < ROUND_TRIP_PX


def test_valid_just_inside_and_not_just_outside(camera: Camera, rng: np.random.Generator) -> None:
    edge = camera.max_angle_rad
    phi = rng.uniform(-np.pi, np.pi, 200)
    assert 0.0 < edge <= np.pi
    for factor, expected in ((1.0 - EDGE, True), (1.0 + EDGE, False)):
        theta = factor * edge
        rays = np.stack(
            [np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.full(200, np.cos(theta))], axis=-1
        )
        if theta >= np.pi:
            continue
        pixels, valid = camera.project(rays)
        assert (valid == expected).all()
        assert (np.isfinite(pixels).all(axis=-1) == expected).all()
        _, valid, d_pixels_d_point, d_pixels_d_parameters = camera.project_with_jacobians(rays)
        assert (valid == expected).all()
        assert (np.isfinite(d_pixels_d_point).all(axis=(-1, -2)) == expected).all()
        assert (np.isfinite(d_pixels_d_parameters).all(axis=(-1, -2)) == expected).all()


def test_no_two_rays_share_a_pixel(camera: Camera, rng: np.random.Generator) -> None:
    """Whatever the model accepts, anywhere on the sphere, must come back as itself: no folded region is let in."""
    rays = rng.normal(size=(4000, 3))
    rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
    angle = np.arctan2(np.hypot(rays[:, 0], rays[:, 1]), rays[:, 2])
    pixels, valid = camera.project(rays)
    assert valid.mean() > 0.01
    assert not valid[angle > camera.max_angle_rad].any()
    inner = valid & (angle < _field(camera))
    again, seen = camera.unproject(pixels[inner])
    assert seen.all()
    assert np.abs(again - rays[inner]).max() < ROUND_TRIP_RAY


def test_far_pixels_are_refused_or_come_back(camera: Camera) -> None:
    far = (image_pixels(camera) - np.array(camera.size_px) / 2.0) * 20.0
    rays, valid = camera.unproject(far)
    assert np.isnan(rays[~valid]).all()
    again, seen = camera.project(rays[valid])
    assert np.abs(again[seen] - far[valid][seen]).max(initial=0.0) < 1e-6
    assert seen.mean() >= VALID_SHARE if valid.any() else True


@pytest.mark.parametrize("batch", [(), (5,), (3, 4), (0,)])
def test_broadcasting(camera: Camera, rng: np.random.Generator, batch: tuple[int, ...]) -> None:
    count = int(np.prod(batch))
    points = rays_within(0.3, max(count, 1), rng)[:count].reshape(*batch, 3)
    size = camera.parameters.size
    pixels, valid = camera.project(points)
    rays, seen = camera.unproject(pixels)
    again, also, d_pixels_d_point, d_pixels_d_parameters = camera.project_with_jacobians(points)
    assert pixels.shape == again.shape == (*batch, 2)
    assert valid.shape == also.shape == seen.shape == batch
    assert rays.shape == (*batch, 3)
    assert d_pixels_d_point.shape == (*batch, 2, 3)
    assert d_pixels_d_parameters.shape == (*batch, 2, size)
    assert camera.ray_jacobian(pixels).shape == (*batch, 3, 2)
    assert all(a.dtype == np.float64 for a in (pixels, rays, d_pixels_d_point, d_pixels_d_parameters))
    assert valid.all() and seen.all() and also.all()
    if count:
        one = camera.project(points.reshape(-1, 3)[0])[0]
        assert np.abs(one - pixels.reshape(-1, 2)[0]).max() < ROUND_TRIP_PX


def test_arguments_unchanged(camera: Camera, rng: np.random.Generator) -> None:
    points, pixels = rays_within(0.3, 9, rng), image_pixels(camera)
    kept_points, kept_pixels, kept_parameters = points.copy(), pixels.copy(), camera.parameters.copy()
    camera.project(points)
    camera.project_with_jacobians(points)
    camera.unproject(pixels)
    camera.ray_jacobian(pixels)
    assert np.array_equal(points, kept_points)
    assert np.array_equal(pixels, kept_pixels)
    assert np.array_equal(camera.parameters, kept_parameters)
    with pytest.raises(ValueError, match="read-only"):
        camera.parameters[0] = 1.0


def test_nan_in_gives_invalid_out(camera: Camera) -> None:
    good = np.array([0.1, -0.2, 1.0])
    bad = np.array([[np.nan, 0.0, 1.0], [0.0, np.nan, 1.0], [0.0, 0.0, np.nan], [np.inf, 0.0, 1.0], [0.0, 0.0, 0.0]])
    points = np.concatenate([bad, good[None]])
    pixels, valid = camera.project(points)
    assert valid.tolist() == [False] * 5 + [True]
    assert np.isnan(pixels[:-1]).all()
    _, valid, d_pixels_d_point, d_pixels_d_parameters = camera.project_with_jacobians(points)
    assert valid.tolist() == [False] * 5 + [True]
    assert np.isnan(d_pixels_d_point[:-1]).all() and np.isnan(d_pixels_d_parameters[:-1]).all()
    assert np.isfinite(d_pixels_d_point[-1]).all() and np.isfinite(d_pixels_d_parameters[-1]).all()
    wrong = np.array([[np.nan, 100.0], [100.0, np.nan], [np.inf, 100.0], [640.0, 480.0]])
    rays, valid = camera.unproject(wrong)
    assert valid.tolist() == [False, False, False, True]
    assert np.isnan(rays[:-1]).all()
    jacobian = camera.ray_jacobian(wrong)
    assert np.isnan(jacobian[:-1]).all() and np.isfinite(jacobian[-1]).all()


def test_parameters_round_trip(camera: Camera) -> None:
    again = type(camera)(camera.size_px, np.array(list(camera.parameters)))
    assert np.array_equal(again.parameters, camera.parameters)
    assert again.parameter_names() == camera.parameter_names()
    assert len(set(camera.parameter_names())) == camera.parameters.size
    with pytest.raises(InputError, match="parameters"):
        type(camera)(camera.size_px, np.append(camera.parameters, np.zeros(20)))
    with pytest.raises(InputError, match="NaN"):
        camera.with_parameters(np.full(camera.parameters.size, np.nan))
    with pytest.raises(InputError, match="positive"):
        type(camera)((0, 10), camera.parameters)


def test_radial_curve_gives_the_camera_back(camera: Camera) -> None:
    """A curve sampled from a radially symmetric camera of the model is followed by the fit."""
    reach = min(_field(camera), np.radians(95.0), 0.93 * camera.max_angle_rad)
    theta = np.linspace(0.0, reach, 80)
    points = np.stack([np.sin(theta), np.zeros(80), np.cos(theta)], axis=-1)
    names = camera.parameter_names()
    plain = camera.parameters.copy()
    for name, value in (("p1", 0.0), ("p2", 0.0), ("d", 0.0), ("c", 1.0)):
        if name in names:
            plain[names.index(name)] = value
    truth = camera.with_parameters(plain)
    centre = plain[[names.index("cx"), names.index("cy")]]
    radius = truth.project(points)[0][:, 0] - centre[0]
    order = {"brown": plain.size - 4, "scaramuzza": plain.size - 4}.get(camera.model)
    fitted = type(camera).from_radial_curve(camera.size_px, RadialCurve(centre, theta, radius), order=order)
    assert fitted.parameters.size == camera.parameters.size
    error = fitted.project(points)[0][:, 0] - centre[0] - radius
    assert np.abs(error).max() < CURVE_PX
    with pytest.raises(InputError, match="increase"):
        type(camera).from_radial_curve(camera.size_px, RadialCurve(centre, theta[::-1], radius), order=order)


def test_parameters_of_no_lens_are_refused_or_harmless(camera: Camera, rng: np.random.Generator) -> None:
    """A solver may try anything: an error of ours, or a camera that does not crash and says what is invalid."""
    points, pixels = rays_within(1.0, 20, rng), image_pixels(camera, 5, 5)
    made = 0
    for _ in range(60):
        scale = 10.0 ** rng.uniform(-3.0, 12.0, camera.parameters.size)
        try:
            wild = camera.with_parameters(camera.parameters * rng.choice([1.0, -1.0, 0.0], scale.size) * scale)
        except InputError:
            continue
        made += 1
        for values, valid in (wild.project(points), wild.unproject(pixels)):
            assert (np.isnan(values).any(axis=-1) | valid).all()
        wild.project_with_jacobians(points)
    assert made > 0 or camera.model not in ("pinhole", "brown", "kannala_brandt")


@pytest.mark.parametrize("size", [(True, 480), ("640", 480), (640.5, 480), (640, 10**12), (0, 480), (640, -480)])
def test_sizes_that_are_none_are_refused(size: tuple[int, int]) -> None:
    with pytest.raises(InputError, match="camera size"):
        Pinhole(size, np.array([500.0, 500.0, 320.0, 240.0]))


@pytest.mark.parametrize("name", sorted(sample_cameras()))
@pytest.mark.parametrize("value", [True, "500", 1e300, -1e300, np.nan])
def test_parameters_that_are_none_are_refused(name: str, value: object) -> None:
    """Each of them in turn, given as a list as files give it; the right ones are taken."""
    camera = sample_cameras()[name]
    right = camera.parameters.tolist()
    assert (type(camera)(camera.size_px, right).parameters == camera.parameters).all()
    for k in range(len(right)):
        with pytest.raises(InputError, match=camera.model):
            type(camera)(camera.size_px, [*right[:k], value, *right[k + 1 :]])  # type: ignore[arg-type]
