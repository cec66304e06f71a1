"""The kernels of board poses: residuals and least-squares poses against numpy."""

from __future__ import annotations

import numpy as np
import pytest
from kernels.reference import board_pose as reference

from rigkit.geometry.board_pose import point_residuals, ray_residuals, tangent_bases
from rigkit.geometry.rotation import exp_so3, unit
from rigkit.kernels.board_pose import refine

ROUNDING = 1e-12
"""Of the largest value: both sum three products, in orders of their own."""
AT_MINIMUM = 1e-9
"""Of a radian and of the distance: the cost is flat to its rounding over some 1e-10."""


@pytest.mark.parametrize("sets", [(), (3,)], ids=["one set of rays", "a set for each pose"])
def test_residuals_of_boards_are_those_of_their_points(sets: tuple[int, ...], rng: np.random.Generator) -> None:
    points = rng.uniform(-100.0, 100.0, (7, 3))
    rotation, translation = exp_so3(rng.normal(size=(3, 3))), rng.uniform(-300.0, 300.0, (3, 3))
    # In all directions, the opposite ray among them.
    rays = unit(rng.normal(size=(*sets, 7, 3)))
    rays[..., 2, :] = -unit(points[2] @ rotation[0].T + translation[0])
    bases = tangent_bases(rays) * 40.0
    expected = reference.ray_residuals(rays, bases, points, rotation, translation)
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
    there = points @ rotation[0].T + translation[0]
    of_points = point_residuals(rays[(0,) * len(sets)], bases[(0,) * len(sets)], there)
    for one, other in zip(of_points, (found[0][0], found[1][0, :, :, 3:]), strict=True):
        typical = np.arange(7) != 2
        np.testing.assert_allclose(one[typical], other[typical], rtol=0.0, atol=ROUNDING * np.abs(other[typical]).max())


@pytest.mark.parametrize("sets", [1, 6], ids=["one set of rays", "a set for each pose"])
def test_poses_go_to_the_minima_near_them(sets: int, rng: np.random.Generator) -> None:
    grid = np.stack(np.meshgrid(np.arange(9.0), np.arange(6.0)), axis=-1).reshape(-1, 2) - [4.0, 2.5]
    points = 30.0 * np.column_stack([grid, np.zeros(len(grid))])
    true, at = exp_so3(rng.normal(0.0, 0.4, (sets, 3))), rng.uniform([-200, -200, 400], [200, 200, 900], (sets, 3))
    seen = points @ np.swapaxes(true, 1, 2) + at[:, None]
    rays = unit(unit(seen) + rng.normal(0.0, 1e-3, seen.shape))
    bases = tangent_bases(rays) * rng.uniform(0.5, 2.0, (len(points), 1, 1))
    turned, moved = exp_so3(rng.normal(0.0, 0.3, (6, 3))) @ true, at * rng.uniform(0.6, 1.5, (6, 1))
    start = turned.copy(), moved.copy()
    found = refine(rays, bases, points, *start, 50, 1e-12)
    expected = reference.refine(rays, bases, points, (turned, moved), 50)
    for one, other, size in zip(found, expected, (1.0, 500.0, expected[2].max()), strict=True):
        np.testing.assert_allclose(one, other, rtol=0.0, atol=AT_MINIMUM * size)
    begun, _ = reference.ray_residuals(rays, bases, points, turned, moved)
    assert (found[2] < 0.1 * (begun**2).sum(axis=(1, 2))).all()
    # What is given is not written to.
    for given, kept in zip(start, (turned, moved), strict=True):
        np.testing.assert_array_equal(given, kept)
    once, _, _ = refine(rays, bases, points, *start, 1, 1e-12)
    np.testing.assert_allclose(once, reference.refine(rays, bases, points, start, 1)[0], atol=AT_MINIMUM)


def test_a_pose_without_a_number_stays() -> None:
    points = np.array([[0.0, 0.0, 0.0], [60.0, 0.0, 0.0], [60.0, 40.0, 0.0], [0.0, 40.0, 0.0]])
    rays = unit(points + np.array([-20.0, 10.0, 300.0]))[None]
    rotation, translation = np.tile(np.eye(3), (2, 1, 1)), np.array([[0.0, 0.0, 250.0], [0.0, np.nan, 250.0]])
    R, t, cost = refine(rays, tangent_bases(rays), points, rotation, translation, 50, 1e-12)
    assert cost[0] < 1e-20 and np.isnan(cost[1])
    np.testing.assert_allclose(t[0], [-20.0, 10.0, 300.0], atol=1e-6)
    np.testing.assert_array_equal(R[1], np.eye(3))
    np.testing.assert_array_equal(t[1], translation[1])
