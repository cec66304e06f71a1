"""Clouds of several pairs fused: nearer to the exact surface than each, normals to their cameras, nothing twice."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from helpers.textured_scene import Corner

from rigkit.affine.features import match_affine_features
from rigkit.cameras.pinhole import Pinhole
from rigkit.core.errors import InputError
from rigkit.geometry.rigid3 import Rigid3
from rigkit.geometry.rotation import angle_between, exp_so3
from rigkit.reconstruction.growing.dense import grow_scene
from rigkit.reconstruction.growing.fuse import PosedCloud, fuse_clouds
from rigkit.reconstruction.scene import reconstruct_scene
from rigkit.reconstruction.scene_pose import KnownPose

CAMERA = Pinhole((300, 225), np.array([262.5, 262.5, 149.5, 112.0]))
TURNS = ((0.0, 0.0, 0.0), (0.05, -0.25, 0.1), (0.02, -0.12, 0.05))
PLACES_MM = ((0.0, 0.0, 0.0), (320.0, -60.0, 60.0), (150.0, -90.0, 30.0))
CAM_FROM_WORLD = tuple(
    Rigid3(exp_so3(np.array(w)), -exp_so3(np.array(w)) @ np.array(c)) for w, c in zip(TURNS, PLACES_MM, strict=True)
)


@cache
def corner_clouds() -> tuple[Corner, list[PosedCloud]]:
    rng = np.random.default_rng(5)
    corner = Corner.of_a_room()
    images = [corner.image(CAMERA, pose, rng) for pose in CAM_FROM_WORLD]
    clouds = []
    for i, j in ((0, 1), (0, 2), (2, 1)):
        pose = CAM_FROM_WORLD[j] @ CAM_FROM_WORLD[i].inverse()
        seeds = match_affine_features(images[i], images[j])
        known = KnownPose(pose)
        sparse = reconstruct_scene(seeds, CAMERA, CAMERA, known_pose=known, image1=images[i])
        dense = grow_scene(sparse, seeds, images[i], images[j], pose_is_known=True)
        clouds.append(PosedCloud.of(dense, CAM_FROM_WORLD[i].inverse()))
    return corner, clouds


def distances(corner: Corner, points: np.ndarray) -> np.ndarray:
    """From the nearest of the three planes."""
    return np.abs((points - corner.apex_mm) @ corner.axes).min(axis=1)


def test_what_pairs_say_of_one_place_becomes_one_point_and_more_exact() -> None:
    corner, clouds = corner_clouds()
    fused = fuse_clouds(clouds)
    sizes = [len(c.cloud) for c in clouds]
    assert max(sizes) < len(fused.cloud) < 0.75 * sum(sizes)
    assert fused.pairs_of.sum() == sum(sizes)
    assert len(fused.cloud) == len(fused.pairs_of) == len(fused.source)
    merged = fused.pairs_of >= 2
    assert merged.sum() > 2000
    # All points of the first of the fused clouds are there, in their order.
    first = fused.source == fused.source[0]
    posed = clouds[fused.source[0]]
    alone = distances(corner, posed.world_from_cam.apply(posed.cloud.points_mm))
    assert first.sum() == len(alone)
    together, alone = distances(corner, fused.cloud.points_mm)[first & merged], alone[merged[first]]
    assert np.sqrt(np.mean(together**2)) < np.sqrt(np.mean(alone**2))
    assert np.quantile(together, 0.9) < np.quantile(alone, 0.9)
    # Half of the points are as good as the interpolation of the images, in which all pairs err alike.
    assert np.median(together) < 1.1 * np.median(alone)
    # Towards the camera that saw the point, and turned by no more than grown normals are.
    centres = np.array([c.world_from_cam.translation_mm for c in clouds])[fused.source]
    assert (np.sum(fused.cloud.normals * (fused.cloud.points_mm - centres), axis=1) < 0.0).all()
    plane = np.argmin(np.abs((fused.cloud.points_mm - corner.apex_mm) @ corner.axes), axis=1)
    angle = angle_between(fused.cloud.normals, corner.axes.T[plane])
    assert np.degrees(np.median(np.minimum(angle, np.pi - angle))) < 1.0


def test_the_order_of_the_clouds_and_the_frame_do_not_matter() -> None:
    _, clouds = corner_clouds()
    fused = fuse_clouds(clouds)
    turned = fuse_clouds(clouds[::-1])
    assert len(turned.cloud) == len(fused.cloud)
    np.testing.assert_allclose(turned.cloud.points_mm, fused.cloud.points_mm, atol=1e-9)


def test_one_cloud_stays_and_surfaces_apart_are_not_merged() -> None:
    _, clouds = corner_clouds()
    alone = fuse_clouds(clouds[:1])
    np.testing.assert_allclose(alone.cloud.points_mm, clouds[0].world_from_cam.apply(clouds[0].cloud.points_mm))
    np.testing.assert_allclose(alone.cloud.sigma_mm, clouds[0].cloud.sigma_mm)
    far = PosedCloud(
        cloud=clouds[0].cloud,
        pixels=clouds[0].pixels,
        step_px=clouds[0].step_px,
        camera=CAMERA,
        # By far more than any sigma.
        world_from_cam=clouds[0].world_from_cam @ Rigid3(np.eye(3), [0.0, 0.0, 200.0]),
    )
    apart = fuse_clouds([clouds[0], far])
    assert (apart.pairs_of == 1).mean() > 0.95


def test_without_clouds_there_is_none_to_fuse() -> None:
    with pytest.raises(InputError, match="none to fuse"):
        fuse_clouds([])
