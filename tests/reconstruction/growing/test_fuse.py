"""Fusion of clouds of several pairs: closer to the exact surface than each, normals facing cameras, no duplicates."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from helpers.textured_scene import Corner
from numpy.typing import NDArray

from rigkit.affine.features import match_affine_features
from rigkit.cameras.pinhole import Pinhole
from rigkit.cameras.uncertain import UncertainRig
from rigkit.core.errors import DegenerateError, InputError
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

PAIRS = ((0, 1), (0, 2), (2, 1))


@cache
def corner_images() -> tuple[Corner, list[NDArray[np.uint8]]]:
    rng = np.random.default_rng(5)
    corner = Corner.of_a_room()
    return corner, [corner.image(CAMERA, pose, rng) for pose in CAM_FROM_WORLD]


@cache
def corner_cloud(i: int, j: int) -> PosedCloud:
    """The cloud of one pair, by a rig that is known exactly."""
    rig = UncertainRig(cameras=[CAMERA] * 3, cam_from_rig=CAM_FROM_WORLD, covariance=np.zeros((24, 24)))
    return cloud_of(corner_images()[1], rig, i, j)


def corner_clouds() -> tuple[Corner, list[PosedCloud]]:
    return corner_images()[0], [corner_cloud(i, j) for i, j in PAIRS]


def cloud_of(images: Sequence[NDArray[np.generic]], rig: UncertainRig, i: int, j: int) -> PosedCloud:
    known = rig.pair(i, j)
    seeds = match_affine_features(images[i], images[j])
    pose = KnownPose(known.posed.cam2_from_cam1, moved=tuple(known.moved()))
    sparse = reconstruct_scene(seeds, *known.posed[:2], known_pose=pose, image1=images[i])
    of_rig = known if rig.covariance.any() else None
    dense = grow_scene(sparse, seeds, images[i], images[j], pose_is_known=True, calibrations=of_rig)
    place = rig.pair(i, 0)
    return PosedCloud.of(dense, place.posed.cam2_from_cam1, place.covariance[-6:, -6:])


def clouds_of(images: Sequence[NDArray[np.generic]], rig: UncertainRig) -> list[PosedCloud]:
    return [cloud_of(images, rig, i, j) for i, j in PAIRS]


def distances(corner: Corner, points: np.ndarray) -> np.ndarray:
    """From the nearest of the three planes."""
    return np.abs((points - corner.apex_mm) @ corner.axes).min(axis=1)


def test_points_of_several_pairs_fuse_into_one_more_exact_point() -> None:
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
    assert np.quantile(together, 0.99) < np.quantile(alone, 0.99)
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


def test_rig_uncertainty_is_in_the_sigmas_and_is_not_averaged_away() -> None:
    """A rig with lenses and mounts as wrong as its covariance says, and the same one that is said to be exact."""
    rng = np.random.default_rng(7)
    corner = Corner.of_a_room()
    images = [corner.image(CAMERA, pose, rng) for pose in CAM_FROM_WORLD]
    sigmas = np.array([0.1] * 12 + [2e-4, 2e-4, 2e-4, 0.3, 0.3, 0.3] * 2)
    wrong = rng.permuted(np.tile([1.0, -1.0], 12)) * sigmas
    cameras = [CAMERA.with_parameters(CAMERA.parameters + own) for own in np.split(wrong[:12], 3)]
    poses = [CAM_FROM_WORLD[0]] + [
        Rigid3(exp_so3(own[:3]) @ pose.rotation, pose.translation_mm + own[3:])
        for pose, own in zip(CAM_FROM_WORLD[1:], np.split(wrong[12:], 2), strict=True)
    ]
    with pytest.raises(DegenerateError, match="the cameras have not moved since"):
        clouds_of(images, UncertainRig(cameras=cameras, cam_from_rig=poses, covariance=np.zeros((24, 24))))
    clouds = clouds_of(images, UncertainRig(cameras=cameras, cam_from_rig=poses, covariance=np.diag(sigmas**2)))
    fused = fuse_clouds(clouds)
    assert fused.cloud.calibration_in_sigmas
    # All 24 numbers are off by one sigma each, and distances from planes are less than those along rays.
    assert 0.1 < np.median(distances(corner, fused.cloud.points_mm) / fused.cloud.sigma_mm) < 1.5
    merged = fused.pairs_of > 1
    assert merged.mean() > 0.2
    assert np.median(fused.cloud.sigma_mm[merged]) > 0.9 * min(np.median(c.of_calibrations[0]) for c in clouds)


def test_one_cloud_stays_and_surfaces_apart_are_not_merged() -> None:
    one = corner_cloud(0, 1)
    alone = fuse_clouds([one])
    np.testing.assert_allclose(alone.cloud.points_mm, one.world_from_cam.apply(one.cloud.points_mm))
    np.testing.assert_allclose(alone.cloud.sigma_mm, one.cloud.sigma_mm)
    # By far more than any sigma.
    far = replace(one, world_from_cam=one.world_from_cam @ Rigid3(np.eye(3), [0.0, 0.0, 200.0]))
    apart = fuse_clouds([one, far])
    assert (apart.pairs_of == 1).mean() > 0.95


def test_without_clouds_there_is_none_to_fuse() -> None:
    with pytest.raises(InputError, match="no cloud to fuse"):
        fuse_clouds([])
