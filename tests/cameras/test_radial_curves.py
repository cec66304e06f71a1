"""from_radial_curve starts every model close enough to any lens in its field of view for a solver to converge."""

from __future__ import annotations

import numpy as np
import pytest
from helpers.cameras import sample_cameras

from rigkit.cameras.base import RadialCurve
from rigkit.cameras.brown import Brown
from rigkit.cameras.kannala_brandt import KannalaBrandt
from rigkit.cameras.pinhole import Pinhole
from rigkit.cameras.registry import MODELS
from rigkit.cameras.scaramuzza import DEGREES, Scaramuzza
from rigkit.core.errors import InputError

SIZE_PX = (1624, 1240)
CENTRE_PX = np.array([805.0, 622.0])
# Full field of view in degrees -> focal length in px and k1..k4 of a lens that fills the image.
LENSES = {
    30: (3000.0, (-0.02, 0.001, 0.0, 0.0)),
    60: (1360.0, (0.3, 0.05, 0.0, 0.0)),
    115: (820.0, (-0.02, 0.004, -0.002, 0.0003)),
    185: (371.6, (-0.011, 0.0043, -0.0024, 0.0002)),
    200: (340.0, (-0.03, 0.003, -0.001, 0.0)),
}
START_PX = 5.0
"""Model against lens, noise-free: the unified camera is 4.5 px off a lens of 200 degrees, all others less than 2."""
NOISY_RMS_PX = 1.0
"""With 0.5 px of noise on 60 samples the fit of 2 to 8 numbers averages most of it."""

WITH_SHAPE = sorted({camera.model for camera in sample_cameras().values() if camera.parameters.size > 4})
"""Models that can come near: without parameters of the shape a lens is what it is."""


def _curve(fov_deg: int) -> tuple[np.ndarray, np.ndarray]:
    focal, k = LENSES[fov_deg]
    theta = np.linspace(0.0, np.radians(fov_deg / 2.0), 60)
    return theta, focal * theta * (1.0 + sum(c * theta ** (2 * i) for i, c in enumerate(k, start=1)))


def _radius(camera, theta: np.ndarray) -> np.ndarray:
    pixels, valid = camera.project(np.stack([np.sin(theta), np.zeros_like(theta), np.cos(theta)], axis=-1))
    assert valid.all()
    return np.asarray(pixels[:, 0] - CENTRE_PX[0])


@pytest.mark.parametrize("fov_deg", sorted(LENSES))
@pytest.mark.parametrize("model", WITH_SHAPE)
def test_start_is_near(model: str, fov_deg: int, rng: np.random.Generator) -> None:
    theta, radius = _curve(fov_deg)
    if model == "brown" and fov_deg >= 180:
        with pytest.raises(InputError, match="less than 90"):
            MODELS[model].from_radial_curve(SIZE_PX, RadialCurve(CENTRE_PX, theta, radius))
        return
    camera = MODELS[model].from_radial_curve(SIZE_PX, RadialCurve(CENTRE_PX, theta, radius))
    assert camera.size_px == SIZE_PX
    assert np.abs(_radius(camera, theta) - radius).max() < START_PX
    assert camera.max_angle_rad > theta[-1]
    noisy = np.maximum.accumulate(radius + 0.5 * rng.normal(size=60) + 1e-6 * np.arange(60))
    keep = np.append(True, np.diff(noisy) > 0.0) & (noisy > 0.0)
    noisy_camera = MODELS[model].from_radial_curve(SIZE_PX, RadialCurve(CENTRE_PX, theta[keep], noisy[keep]))
    error = _radius(noisy_camera, theta[keep]) - _radius(camera, theta[keep])
    assert np.sqrt(np.mean(error**2)) < NOISY_RMS_PX


def test_higher_degrees_follow_better() -> None:
    theta, radius = _curve(185)
    worst = []
    for degree in DEGREES:
        camera = Scaramuzza.from_radial_curve(SIZE_PX, RadialCurve(CENTRE_PX, theta, radius), order=degree)
        assert camera.degree == degree
        assert camera.parameters.size == degree + 4
        worst.append(np.abs(_radius(camera, theta) - radius).max())
    assert worst[DEGREES.index(4)] < 1.0
    assert worst[DEGREES.index(6)] < 0.1
    assert worst[DEGREES.index(8)] < 0.01
    assert worst[-1] < worst[0]


def test_terms_of_brown() -> None:
    theta, radius = _curve(60)
    sizes = {
        order: Brown.from_radial_curve(SIZE_PX, RadialCurve(CENTRE_PX, theta, radius), order=order)
        for order in (4, 5, 8)
    }
    assert [c.parameters.size for c in sizes.values()] == [8, 9, 12]
    assert np.abs(_radius(sizes[8], theta) - radius).max() < np.abs(_radius(sizes[4], theta) - radius).max()
    with pytest.raises(InputError, match="choose 4"):
        Brown.from_radial_curve(SIZE_PX, RadialCurve(CENTRE_PX, theta, radius), order=6)
    with pytest.raises(InputError, match="degree 12"):
        Scaramuzza.from_radial_curve(SIZE_PX, RadialCurve(CENTRE_PX, theta, radius), order=12)


@pytest.mark.parametrize(("model", "squeeze"), [("kannala_brandt", 1.0), ("scaramuzza", 1.0), ("brown", 0.7)])
def test_a_curve_that_flattens_at_its_end_does_not_fold_the_camera(model: str, squeeze: float) -> None:
    """The polynomial of most terms would turn down just inside such a curve, and the corners would be lost."""
    theta = squeeze * np.linspace(0.0, 1.4, 60)
    radius = np.linspace(0.0, 560.0, 60)
    radius[-8:] = radius[-9] + np.linspace(0.01, 0.5, 8)
    camera = MODELS[model].from_radial_curve(SIZE_PX, RadialCurve(CENTRE_PX, theta, radius))
    assert camera.max_angle_rad > theta[-1]


def test_curves_that_no_camera_has_are_refused() -> None:
    theta, radius = _curve(60)
    for bad_theta, bad_radius, words in (
        (theta[:4], radius[:4], "at least 4"),
        (theta, radius[::-1], "increase"),
        (theta, np.where(radius == radius[30], np.nan, radius), "NaN"),
        (theta, radius[:-1], "shape"),
        (np.degrees(theta), radius, "radians"),
    ):
        with pytest.raises(InputError, match=words):
            KannalaBrandt.from_radial_curve(SIZE_PX, RadialCurve(CENTRE_PX, bad_theta, bad_radius))
    with pytest.raises(InputError, match="90"):
        Pinhole.from_radial_curve(SIZE_PX, RadialCurve(CENTRE_PX, *_curve(185)))
