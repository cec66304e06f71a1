"""The kernel of Brown's camera agrees with its definition in numpy."""

from __future__ import annotations

import numpy as np
import pytest
from kernels.reference import brown as reference

from rigkit.kernels.cameras import brown_pixels, brown_places

PARAMETERS = np.array([1364.0, 1290.0, 801.0, 617.0, -0.19, 0.11, 1e-3, -2e-3, 0.01, 0.02, -0.03, 0.004])
ROUNDING = 1e-12
"""Of each number and of one pixel."""


@pytest.mark.parametrize("count", [8, 9, 12])
@pytest.mark.parametrize("within", [False, True])
def test_pixels_and_derivatives_are_as_defined(count: int, within: bool, rng: np.random.Generator) -> None:
    """Points inside and outside the field of view and behind the camera, NaN among them; memory of its own or a part of
    larger arrays; without parameters where only the points matter."""
    points = rng.normal(size=(200, 3)) * [0.5, 0.5, 0.4] + [0.0, 0.0, 0.6]
    points[7] = np.nan
    pixels, valid, d_pixels_d_point, d_pixels_d_parameters = reference.derivatives(points, PARAMETERS[:count], 0.9)
    assert 0.2 < valid.mean() < 0.9
    margin = 2 if within else 0
    one, other = np.zeros((2, 3 + margin, 200)), np.zeros((2, count + margin, 200))
    d_point, d_parameters = one[:, margin:], other[:, margin:]
    x, y, z = points.T
    u, v, seen = brown_pixels((x, y, z), PARAMETERS[:count], 0.9, d_point, d_parameters)
    assert (seen == valid).all()
    for found, expected in (
        (np.stack([u, v], axis=-1), pixels),
        (np.moveaxis(d_point, -1, 0), d_pixels_d_point),
        (np.moveaxis(d_parameters, -1, 0), d_pixels_d_parameters),
    ):
        np.testing.assert_allclose(found[valid], expected[valid], rtol=ROUNDING, atol=ROUNDING)
    assert not one[:, :margin].any() and not other[:, :margin].any()
    alone = np.empty((2, 3, 200))
    brown_pixels((x, y, z), PARAMETERS[:count], 0.9, alone, None)
    np.testing.assert_array_equal(alone, d_point)
    np.testing.assert_array_equal(brown_pixels((x, y, z), PARAMETERS[:count], 0.9), (u, v, seen))


@pytest.mark.parametrize("count", [8, 9, 12])
def test_places_are_those_that_are_distorted_to_what_is_given(count: int, rng: np.random.Generator) -> None:
    """From starts that are a few hundredths off; what is no number comes to no end."""
    plane = rng.uniform(-0.5, 0.5, (200, 2))
    points = np.concatenate([plane, np.ones((200, 1))], axis=1)
    pixels = reference.derivatives(points, PARAMETERS[:count], 0.9)[0]
    m = ((pixels - PARAMETERS[2:4]) / PARAMETERS[:2]).T
    m[:, 7] = np.nan
    found, settled = brown_places(m, plane.T + rng.normal(0.0, 0.03, (2, 200)), PARAMETERS[:count], 0.9)
    assert (settled == (np.arange(200) != 7)).all()
    np.testing.assert_allclose(found[:, settled], plane[settled].T, atol=ROUNDING)
