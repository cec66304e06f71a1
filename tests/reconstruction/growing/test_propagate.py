"""Holes of a surface take the planes of neighbours, where the pixels agree with them."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from helpers.textured_scene import CAM2_FROM_CAM1, SMALL_LENSES, Corner

from rigkit.affine.features import match_affine_features
from rigkit.core.arrays import BoolArray
from rigkit.geometry.rigid3 import Rigid3
from rigkit.reconstruction.growing import dense as dense_module
from rigkit.reconstruction.growing import propagate
from rigkit.reconstruction.growing.dense import DenseScene, grow_scene
from rigkit.reconstruction.scene import reconstruct_scene
from rigkit.reconstruction.scene_pose import KnownPose

CAMERA = SMALL_LENSES["pinhole"]
HOLES = np.zeros((80, 107), dtype=bool)
HOLES[8:-8:14, 8:-8:14] = HOLES[9:-7:14, 8:-8:14] = HOLES[9:-7:14, 9:-7:14] = True


@pytest.fixture(scope="module")
def corner() -> tuple[Corner, DenseScene, DenseScene]:
    """A corner of a room as it is reconstructed, and with planes taken away."""
    rng = np.random.default_rng(5)
    room = Corner.of_a_room()
    images = [np.asarray(room.image(CAMERA, pose, rng)) for pose in (Rigid3.identity(), CAM2_FROM_CAM1)]
    seeds = match_affine_features(*images)
    length, known = float(np.linalg.norm(CAM2_FROM_CAM1.translation_mm)), KnownPose(CAM2_FROM_CAM1)
    sparse = reconstruct_scene(seeds, CAMERA, CAMERA, baseline_mm=length, known_pose=known, image1=images[0])
    whole = grow_scene(sparse, seeds, *images, pose_is_known=True)

    def with_holes(*args: Any) -> BoolArray:
        return np.asarray(propagate.at_best_depth(*args) & ~HOLES)

    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(dense_module, "at_best_depth", with_holes)
        return room, whole, grow_scene(sparse, seeds, *images, pose_is_known=True)


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


def test_nothing_is_filled_where_no_pixels_agree(monkeypatch: pytest.MonkeyPatch) -> None:
    plane, slope = np.full((9, 9, 3), [0.0, 0.0, 0.001]), np.ones((9, 9))
    around = propagate._neighbours(np.array([40]), (9, 9))
    assert around.shape == (1, 24) and (around >= 0).all()
    assert (propagate._neighbours(np.array([0]), (9, 9)) < 0).sum() == 15

    class AllAlike:
        def cost_over_rivals(self, *_: Any) -> np.ndarray:
            return np.full(24, 2.0)

    rays, pixels = np.array([[0.0, 0.0, 1.0]]), np.zeros((1, 2))
    alike: Any = AllAlike()
    assert propagate._best(alike, pixels, rays, plane, slope, around).source.tolist() == [-1]
    monkeypatch.setattr(AllAlike, "cost_over_rivals", lambda *_: np.where(np.arange(24) == 7, 0.5, 2.0))
    best = propagate._best(alike, pixels, rays, plane, slope, around)
    assert best.source.tolist() == [around[0, 7]]
    assert best.agree.tolist() == [1.0] and best.scatter.tolist() == [0.0]
