"""The kernels of radially symmetric cameras agree with their definition in numpy."""

from __future__ import annotations

import numpy as np
import pytest
from kernels.reference import radial as reference

from rigkit.kernels.cameras import radial_pixels

K = np.array([-0.013, 0.004, -0.0021, 0.0003])
POLYNOMIAL = np.array([410.0, 0.0, -9.1e-4, 3.1e-7, -4.2e-10, 2.1e-13, -6.3e-17])
LINEAR = np.array([1.002, 3e-4, 1.0, 801.0, 617.0])
ROUNDING = 1e-12
"""Of each number, as a part of it and of one pixel; derivatives near the axis lose a digit more."""


@pytest.mark.parametrize("model", ["kannala_brandt", "scaramuzza"])
def test_pixels_and_derivatives_are_as_defined(model: str, rng: np.random.Generator) -> None:
    """All around, far beyond 90 degrees and beyond what the camera sees; NaN among them. Without derivatives the pixels
    are the same."""
    points = rng.normal(size=(300, 3)) * 10.0 ** rng.uniform(-3.0, 3.0, size=(300, 1))
    points[7] = np.nan
    if model == "scaramuzza":
        given, limits, linear = POLYNOMIAL, (0.0, 760.0), LINEAR
        pixels, valid, d_pixels_d_point, d_pixels_d_parameters = reference.scaramuzza(points, given, linear, limits[1])
    else:
        given, limits, linear = K, (2.1, 0.0), LINEAR * [380.0, 0.0, 377.0, 1.0, 1.0]
        pixels, valid, d_pixels_d_point, d_pixels_d_parameters = reference.kannala_brandt(
            points, given, linear, limits[0]
        )
    assert 0.5 < valid.mean() < 0.95
    d_point, d_parameters = np.zeros((2, 3, 300)), np.zeros((2, d_pixels_d_parameters.shape[-1], 300))
    x, y, z = points.T
    l00, l01, l11, cx, cy = linear.tolist()
    camera = model, (x, y, z), given, (l00, l01, l11, cx, cy), limits
    u, v, seen = radial_pixels(*camera, d_point, d_parameters)
    assert (seen == valid).all()
    size = np.linalg.norm(points, axis=1)[:, None, None]
    for found, expected in (
        (np.stack([u, v], axis=-1), pixels),
        (np.moveaxis(d_point, -1, 0) * size, d_pixels_d_point * size),
        (np.moveaxis(d_parameters, -1, 0), d_pixels_d_parameters),
    ):
        np.testing.assert_allclose(found[valid], expected[valid], rtol=10.0 * ROUNDING, atol=ROUNDING)
    np.testing.assert_array_equal(radial_pixels(*camera), (u, v, seen))


@pytest.mark.parametrize("model", ["kannala_brandt", "scaramuzza"])
def test_on_the_axis_and_at_the_ends_of_numbers(model: str) -> None:
    """On the axis the image is that of a pinhole of the central focal length; behind the camera, at its centre and
    beyond what doubles hold there is none."""
    given, focal, limits = (K, 400.0, (np.pi, 0.0)) if model == "kannala_brandt" else (POLYNOMIAL, 1.0, (0.0, 760.0))
    scale = focal if model == "kannala_brandt" else POLYNOMIAL[0]
    z, other = np.array([2.0, -2.0, 0.0, 1e200, np.inf]), np.zeros(5)
    d_point, d_parameters = np.zeros((2, 3, 5)), np.zeros((2, 8 if model == "kannala_brandt" else 10, 5))
    u, v, valid = radial_pixels(
        model, (other, other, z), given, (focal, 0.0, focal, 5.0, 6.0), limits, d_point, d_parameters
    )
    assert valid.tolist() == [True, False, False, False, False]
    assert (u[0], v[0]) == (5.0, 6.0)
    np.testing.assert_allclose(d_point[:, :, 0], scale / 2.0 * np.eye(2, 3), rtol=ROUNDING)
