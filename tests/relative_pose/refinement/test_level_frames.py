"""Level frames: poses, covariances and the smallest rotation upright."""

from __future__ import annotations

import numpy as np
import pytest

from rigkit.geometry.rigid3 import Rigid3
from rigkit.geometry.rotation import angle_between, exp_so3, log_so3
from rigkit.relative_pose.refinement.level_frames import LevelFrames

FRAMES = LevelFrames(exp_so3(np.array([0.3, -0.2, 0.1])), exp_so3(np.array([-0.1, 0.4, 0.5])))
POSE = Rigid3(exp_so3(np.array([0.2, -0.6, 0.3])), [-300.0, 20.0, 70.0])
STEP = 1e-6


def test_a_point_takes_either_way() -> None:
    point = np.array([200.0, -150.0, 900.0])
    by_level = FRAMES.level_pose(POSE).apply(FRAMES.level1_from_cam1 @ point)
    np.testing.assert_allclose(by_level, FRAMES.level2_from_cam2 @ POSE.apply(point), rtol=1e-12)
    assert FRAMES.camera_pose(FRAMES.level_pose(POSE)).allclose(POSE)


def test_the_covariance_is_that_of_the_cameras_pose(rng: np.random.Generator) -> None:
    level, axis = FRAMES.level_pose(POSE), rng.normal(size=6)
    step = STEP * axis
    moved = FRAMES.camera_pose(Rigid3(exp_so3(step[:3]) @ level.rotation, level.translation_mm + step[3:]))
    turn = log_so3(moved.rotation @ POSE.rotation.T)
    own = np.concatenate([turn, moved.translation_mm - POSE.translation_mm]) / STEP
    np.testing.assert_allclose(FRAMES.camera_covariance(np.outer(axis, axis)), np.outer(own, own), atol=1e-6)


@pytest.mark.parametrize("down", [[0.2, 3.0, -0.4], [1.0, -2.0, 0.5], [0.0, -0.3, 0.0], [0.0, 7.0, 0.0]])
def test_the_rotation_upright_is_the_smallest(down: list[float]) -> None:
    turn, y = LevelFrames.from_down(down, [0.0, 1.0, 0.0]).level1_from_cam1, np.array([0.0, 1.0, 0.0])
    np.testing.assert_allclose(turn @ down, np.linalg.norm(down) * y, atol=1e-12)
    angle = np.arccos(np.clip((np.trace(turn) - 1.0) / 2.0, -1.0, 1.0))
    assert angle == pytest.approx(float(angle_between(np.array(down), y)), abs=1e-7)
