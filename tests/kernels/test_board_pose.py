"""The kernel of residuals of boards against rays, against the formula in numpy."""

from __future__ import annotations

import numpy as np
import pytest
from kernels.reference.board_pose import point_residuals as reference

from rigkit.geometry.board_pose import point_residuals, ray_residuals, tangent_bases
from rigkit.geometry.rotation import exp_so3, skew, unit

ROUNDING = 1e-12
"""Of the largest value: both sum three products, in orders of their own."""


@pytest.mark.parametrize("sets", [(), (3,)], ids=["one set of rays", "a set for each pose"])
def test_residuals_of_boards_are_those_of_their_points(sets: tuple[int, ...], rng: np.random.Generator) -> None:
    points = rng.uniform(-100.0, 100.0, (7, 3))
    rotation, translation = exp_so3(rng.normal(size=(3, 3))), rng.uniform(-300.0, 300.0, (3, 3))
    # In all directions, the opposite ray among them.
    rays = unit(rng.normal(size=(*sets, 7, 3)))
    rays[..., 2, :] = -unit(points[2] @ rotation[0].T + translation[0])
    bases = tangent_bases(rays) * 40.0
    turned = points @ np.swapaxes(rotation, 1, 2)
    residual, d_residuals_d_point = reference(rays, bases, turned + translation[:, None])
    expected = residual, np.concatenate([-d_residuals_d_point @ skew(turned), d_residuals_d_point], axis=-1)
    found = ray_residuals(rays, bases, points, rotation, translation)
    for one, other in zip(found, expected, strict=True):
        typical = np.arange(7) != 2
        limit = ROUNDING * np.abs(other[:, typical]).max()
        np.testing.assert_allclose(one[:, typical], other[:, typical], rtol=0.0, atol=limit)
        # Its residual is rounding over almost nothing: so large that nobody takes it for a fit.
        assert np.isfinite(one).all()
    alone = ray_residuals(rays[(0,) * len(sets)], bases[(0,) * len(sets)], points, rotation[0], translation[0])
    for one, of_many in zip(alone, found, strict=True):
        np.testing.assert_array_equal(one, of_many[0])
    there = turned[0] + translation[0]
    of_points = point_residuals(rays[(0,) * len(sets)], bases[(0,) * len(sets)], there)
    for one, other in zip(of_points, (found[0][0], found[1][0, :, :, 3:]), strict=True):
        typical = np.arange(7) != 2
        np.testing.assert_allclose(one[typical], other[typical], rtol=0.0, atol=ROUNDING * np.abs(other[typical]).max())
