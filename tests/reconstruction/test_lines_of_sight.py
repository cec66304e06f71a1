"""Depth edges of a cloud seen from one place: no surface between foreground and background."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from helpers.depth_edge import FAR_MM, HALF, NEAR_MM, cloud_of, square_before_wall

from rigkit.geometry.rotation import exp_so3, unit
from rigkit.interop.open3d import poisson_mesh
from rigkit.reconstruction.lines_of_sight import with_lines_of_sight


def test_points_run_along_the_lines_of_sight_of_an_edge_and_look_to_the_far_side() -> None:
    cloud = square_before_wall()
    more = with_lines_of_sight(cloud)
    added = more.points_mm[len(cloud) :]
    assert len(added) > 200
    np.testing.assert_array_equal(more.points_mm[: len(cloud)], cloud.points_mm)
    x = added[:, :2] / added[:, 2:]
    # Half a step of the grid inside and outside of the square's border.
    assert (np.abs(np.abs(x).max(axis=1) - HALF) < 0.02).all()
    assert (added[:, 2] > NEAR_MM).all() and (added[:, 2] < FAR_MM).all()
    normals = more.normals[len(cloud) :]
    np.testing.assert_allclose(np.sum(normals * unit(added), axis=1), 0.0, atol=1e-9)
    assert (np.sum(normals[:, :2] * x, axis=1) > 0.0).all()
    assert np.isnan(more.sigma_mm[len(cloud) :]).all()


@pytest.mark.parametrize("slant_deg", [0.0, 60.0, 75.0])
def test_a_slanted_plane_has_no_edge(slant_deg: float) -> None:
    at = np.linspace(-0.15, 0.15, 41)
    x, y = (v.ravel() for v in np.meshgrid(at, at))
    rays = np.stack([x, y, np.ones_like(x)], axis=1)
    normal = exp_so3(np.array([0.0, np.deg2rad(slant_deg), 0.0])) @ [0.0, 0.0, -1.0]
    points = rays * (normal[2] * NEAR_MM / (rays @ normal))[:, None]
    assert len(with_lines_of_sight(cloud_of(points, np.broadcast_to(normal, points.shape)))) == len(points)


def test_the_surface_leaves_what_the_camera_saw_through() -> None:
    """Beside an edge patches fail, and no points are: there a surface through points alone sags into the gap."""
    import open3d

    tensor: Any = open3d.core.Tensor
    whole = square_before_wall()
    aside = np.abs(whole.points_mm[:, :2] / whole.points_mm[:, 2:]).max(axis=1)
    cloud = whole.select((aside < HALF - 0.08) | (aside > HALF))
    at = np.linspace(HALF + 0.03, HALF + 0.1, 9)
    x, y = (v.ravel() for v in np.meshgrid(at, np.linspace(-HALF, HALF, 21)))
    rays = unit(np.stack([x, y, np.ones_like(x)], axis=1))
    shares = []
    for points in (cloud, with_lines_of_sight(cloud)):
        mesh = poisson_mesh(points, depth=6, cut=0.0)
        scene = open3d.t.geometry.RaycastingScene()
        scene.add_triangles(tensor(mesh.points.astype(np.float32)), tensor(mesh.triangles.astype(np.uint32)))
        cast = np.concatenate([np.zeros_like(rays), rays], axis=1).astype(np.float32)
        depth = scene.cast_rays(tensor(cast))["t_hit"].numpy() * rays[:, 2]
        shares.append(np.mean(np.abs(depth / FAR_MM - 1.0) < 0.02))
    assert shares[0] < 0.95
    assert shares[1] > 0.99


def test_too_few_directions_are_left_as_they_are() -> None:
    points = np.array([[0.0, 0.0, 1.0], [0.1, 0.0, 1.0], [0.2, 0.0, 1.0]])
    for count in (1, 3):
        cloud = cloud_of(points[:count], np.broadcast_to([0.0, 0.0, -1.0], (count, 3)))
        assert len(with_lines_of_sight(cloud)) == count
