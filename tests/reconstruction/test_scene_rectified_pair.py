"""Rectified pairs are recognised by their cameras and matches; their pose is exact. Others are estimated."""

from __future__ import annotations

import numpy as np
from helpers.epipolar_scenes import pair

from rigkit.affine.correspondences import Correspondences
from rigkit.cameras.brown import Brown
from rigkit.cameras.pinhole import Pinhole
from rigkit.core.posetype import PoseType
from rigkit.reconstruction.scene import RECTIFIED_NOTE, SceneReconstruction, are_rectified, reconstruct_scene

SIZE = (1600, 1200)
CAMERA = Pinhole(SIZE, np.array([1000.0, 1000.0, 800.0, 600.0]))
NOISE_PX, NOISE_A = 0.3, 0.03


def scene(rng: np.random.Generator, kind: str, declared: str | None) -> SceneReconstruction:
    m, _, _ = pair(rng, 200, kind, noise_px=NOISE_PX, sigma_A=NOISE_A, camera=CAMERA)
    stated = np.full(len(m), NOISE_PX), np.full(len(m), NOISE_A)
    assert m.A21 is not None
    found = Correspondences(m.pixels1, m.pixels2, m.A21, None, *stated)
    return reconstruct_scene(found, CAMERA, CAMERA, pose_type=declared)


def test_perspective_cameras_with_the_same_rows_are_rectified() -> None:
    def other(*change: float) -> Pinhole:
        return Pinhole(SIZE, CAMERA.parameters + np.array(change))

    assert are_rectified(CAMERA, other(0.0, 0.0, 31.0, 0.0))
    assert not are_rectified(CAMERA, other(0.0, 0.0, 0.0, 0.01))
    assert not are_rectified(CAMERA, other(0.01, 0.0, 0.0, 0.0))
    assert not are_rectified(CAMERA, Pinhole((1600, 1000), CAMERA.parameters))
    bent = Brown(SIZE, np.array([1000.0, 1000.0, 800.0, 600.0, -0.01, 0.0, 0.0, 0.0, 0.0]))
    assert not are_rectified(bent, bent)


def test_the_pose_of_a_rectified_pair_is_exact(rng: np.random.Generator) -> None:
    r = scene(rng, "standard", None).reconstruction
    assert r.pose_type is PoseType.STANDARD
    np.testing.assert_array_equal(r.cam2_from_cam1.rotation, np.eye(3))
    np.testing.assert_array_equal(np.abs(r.cam2_from_cam1.translation_mm), [1.0, 0.0, 0.0])
    assert RECTIFIED_NOTE in r.notes


def test_a_declaration_stands_and_other_poses_are_estimated(rng: np.random.Generator) -> None:
    declared = scene(rng, "standard", "general").reconstruction
    assert declared.pose_type is PoseType.GENERAL
    assert RECTIFIED_NOTE not in declared.notes
    moved = scene(rng, "general", None).reconstruction
    assert moved.pose_type is PoseType.GENERAL
    assert np.trace(moved.cam2_from_cam1.rotation) < 3.0
