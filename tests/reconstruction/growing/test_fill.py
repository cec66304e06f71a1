"""Holes of a surface get planes of the sweep, or those of neighbours that agree with it."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import Any

import numpy as np
import pytest
from helpers.textured_scene import CAM2_FROM_CAM1, SMALL_LENSES, Corner

from rigkit.affine.features import match_affine_features
from rigkit.core.arrays import BoolArray
from rigkit.geometry.rigid3 import Rigid3
from rigkit.kernels.sweep import LevelPlanes, fitted_level_planes
from rigkit.reconstruction.growing import dense as dense_module
from rigkit.reconstruction.growing import fill
from rigkit.reconstruction.growing.dense import DenseScene, grow_scene
from rigkit.reconstruction.growing.surface import GrownSurface
from rigkit.reconstruction.scene import reconstruct_scene
from rigkit.reconstruction.scene_pose import KnownPose

CAMERA = SMALL_LENSES["pinhole"]
HOLES = np.zeros((80, 107), dtype=bool)
HOLES[8:-8:14, 8:-8:14] = HOLES[9:-7:14, 8:-8:14] = HOLES[9:-7:14, 9:-7:14] = True


@cache
def grown() -> Callable[[], DenseScene]:
    """A corner of a room, as a function that reconstructs it."""
    rng = np.random.default_rng(5)
    room = Corner.of_a_room()
    images = [np.asarray(room.image(CAMERA, pose, rng)) for pose in (Rigid3.identity(), CAM2_FROM_CAM1)]
    seeds = match_affine_features(*images)
    length, known = float(np.linalg.norm(CAM2_FROM_CAM1.translation_mm)), KnownPose(CAM2_FROM_CAM1)
    sparse = reconstruct_scene(seeds, CAMERA, CAMERA, baseline_mm=length, known_pose=known, image1=images[0])
    return lambda: grow_scene(sparse, seeds, *images, pose_is_known=True)


def with_holes(*args: Any) -> BoolArray:
    """Planes that fit best, without those of the nodes HOLES."""
    return np.asarray(fill.at_best_depth(*args) & ~HOLES)


@pytest.fixture(scope="module")
def corner() -> tuple[Corner, DenseScene, DenseScene]:
    """A corner of a room as it is reconstructed, and with planes taken away."""
    with pytest.MonkeyPatch.context() as patched:
        whole = grown()()
        patched.setattr(dense_module, "at_best_depth", with_holes)
        return Corner.of_a_room(), whole, grown()()


def test_holes_are_filled_with_the_true_surface(corner: tuple[Corner, DenseScene, DenseScene]) -> None:
    _, whole, filled = corner
    before, after = (d.maps()["range"][HOLES] for d in (whole, filled))
    known = np.isfinite(before)
    assert known.sum() > 30 and np.isfinite(after[known]).mean() > 0.9
    off = np.abs(after / before - 1.0)[known & np.isfinite(after)]
    assert np.median(off) < 1e-3 and np.quantile(off, 0.95) < 0.01


def test_filled_points_have_pairs_normals_and_sigmas_as_others_have(
    corner: tuple[Corner, DenseScene, DenseScene],
) -> None:
    room, _, filled = corner
    r = filled.scene.reconstruction
    new = HOLES.ravel()[filled.nodes]
    assert new.sum() > 30 and len(r.pixels1) == len(r.cloud)
    # The pair's affinity is that of its plane.
    pixels, seen = CAMERA.project(CAM2_FROM_CAM1.apply(r.cloud.points_mm))
    assert seen.all()
    assert np.abs(pixels - r.pixels2)[new].max() < 1e-6
    assert (np.sum(r.cloud.normals * r.cloud.points_mm, axis=1) < 0.0).all()
    off = np.abs((r.cloud.points_mm - room.apex_mm) @ room.axes).min(axis=1)[new]
    assert np.mean(off < 2.0 * r.cloud.sigma_mm[new]) > 0.9


def test_a_plane_of_the_sweep_behind_the_camera_leaves_the_others_as_they_are(
    corner: tuple[Corner, DenseScene, DenseScene], monkeypatch: pytest.MonkeyPatch
) -> None:
    _, _, filled = corner

    def first_behind(*args: Any, **rules: Any) -> LevelPlanes:
        fits = fitted_level_planes(*args, **rules)
        fits.planes[0, 0] = -1e6
        return fits

    monkeypatch.setattr(dense_module, "at_best_depth", with_holes)
    monkeypatch.setattr(fill, "fitted_level_planes", first_behind)
    again = grown()()
    np.testing.assert_array_equal(again.nodes, filled.nodes)
    sigma, before = (d.scene.reconstruction.cloud.sigma_mm for d in (again, filled))
    np.testing.assert_allclose(sigma, before, rtol=0.01)


def test_a_hole_gets_the_plane_of_a_neighbour_only_if_the_sweep_agrees_with_it() -> None:
    shape = (9, 9)
    around = fill._neighbours(np.array([40]), shape)
    assert around.shape == (1, 24) and (around >= 0).all()
    assert (fill._neighbours(np.array([0]), shape) < 0).sum() == 15
    plane = np.full((*shape, 3), np.nan)
    plane.reshape(-1, 3)[around[0, :3]] = [[0.0, 0.0, 0.0013], [0.0, 0.0, 0.00102], [0.0, 0.0, 0.00104]]
    known: dict[str, Any] = dict.fromkeys(("points", "normals", "plane", "covariance", "support"), plane)
    surface = GrownSurface(**known)
    ray, slope = np.array([[0.0, 0.0, 1.0]]), np.array([10000.0])
    swept = fill._SweptPlanes(
        nodes=np.array([40]),
        pixels1=np.zeros((1, 2)),
        rays=ray,
        plane=0.001 * ray,
        covariance=np.zeros((1, 3, 3)),
        slope=slope,
        agree=np.ones(1),
    )
    choice = fill._agreeing_neighbours(surface, swept)
    assert choice.source.tolist() == [around[0, 1]]
    # By the one other neighbour that lies within half a pixel of it.
    np.testing.assert_allclose(choice.scatter, 0.5 * 0.00002**2)
    apart = fill._agreeing_neighbours(surface, swept._replace(plane=0.0009 * ray))
    assert apart.source.tolist() == [-1]


def test_the_sigma_of_the_sweep_comes_from_its_differences_to_patches(rng: np.random.Generator) -> None:
    count, sigma = 4000, 1e-5
    rays = np.tile([0.0, 0.0, 1.0], (count, 1))
    planes = fill._SweptPlanes(
        nodes=np.arange(count),
        pixels1=np.zeros((count, 2)),
        rays=rays,
        plane=0.001 * rays,
        covariance=np.tile(sigma**2 * np.eye(3), (count, 1, 1)),
        slope=np.ones(count),
        agree=np.ones(count),
    )
    of_patches = planes.plane + 3.0 * sigma * rng.normal(size=(count, 3))
    assert fill._noise_over_scatter(planes, of_patches) == pytest.approx(3.0, rel=0.1)
    assert fill._noise_over_scatter(planes, planes.plane) == 1.0
