"""Tilted cameras on a vehicle with a known level: planar motion in level frames."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from rigkit.cameras.pinhole import Pinhole
from rigkit.core.boards import Board
from rigkit.core.detections import BoardDetection
from rigkit.core.errors import InputError
from rigkit.core.posetype import PoseType
from rigkit.geometry.rigid3 import Rigid3
from rigkit.geometry.rotation import exp_so3, rotation_angle
from rigkit.reconstruction.geometry import pair_geometry
from rigkit.reconstruction.pairing import MatchedPair, match_pair
from rigkit.relative_pose.refinement.level_frames import LevelFrames
from rigkit.synthetic.pairs import trihedral_pair

CAMERA = Pinhole((1624, 1240), np.array([1350.0, 1350.0, 805.0, 622.0]))
WIDE = Pinhole((4000, 4000), np.array([1350.0, 1350.0, 2000.0, 2000.0]))
BOARDS = tuple(Board(name, 8, 6, 50.0, 50.0) for name in ("front", "floor", "right"))
TILTS = (exp_so3(np.array([0.12, 0.0, -0.05])), exp_so3(np.array([-0.08, 0.0, 0.1])))
"""level_from_cam, of two cameras mounted askew."""
SIGMA_PX = 0.1


def tilted_pair(rng: np.random.Generator) -> tuple[MatchedPair, Rigid3]:
    """A planar pair of level cameras, its corners as the same cameras tilted about their centres see them."""
    scene = trihedral_pair(BOARDS, CAMERA, PoseType.PLANAR, np.random.default_rng(5))
    both: list[list[BoardDetection]] = []
    for found, tilt in zip(scene.detections(), TILTS, strict=True):
        turned = []
        for d in found:
            pixels = WIDE.project(CAMERA.unproject(d.pixels)[0] @ tilt)[0]
            noisy = pixels + SIGMA_PX * rng.normal(size=pixels.shape)
            turned.append(replace(d, pixels=noisy, sigma_px=np.full(len(pixels), SIGMA_PX)))
        both.append(turned)
    level = scene.cam2_from_cam1
    truth = Rigid3(TILTS[1].T @ level.rotation @ TILTS[0], TILTS[1].T @ level.translation_mm)
    return match_pair("pair", WIDE, WIDE, both[0], both[1], BOARDS), truth


def test_known_levels_make_planar_motion_of_tilted_cameras_planar() -> None:
    pair, truth = tilted_pair(np.random.default_rng(0))
    frames = LevelFrames.from_down(TILTS[0].T[:, 1], TILTS[1].T[:, 1])
    found = pair_geometry(pair, pose_type="planar", level_sigma_rad=0.0, level_frames=frames)
    general = pair_geometry(pair, pose_type="general")

    def off(pose: Rigid3) -> float:
        return float(np.rad2deg(rotation_angle(pose.rotation @ truth.rotation.T)))

    assert off(found.metric.cam2_from_cam1) < 0.05
    # Exactly planar there: the rotation keeps the vertical, the translation is level.
    level = frames.level_pose(found.metric.cam2_from_cam1)
    assert level.rotation[:, 1] == pytest.approx([0.0, 1.0, 0.0], abs=1e-12)
    assert abs(level.translation_mm[1]) < 1e-9
    assert not found.decision.notes
    # What is known is not estimated: less uncertain than a general pose, in any direction.
    gain = general.metric.covariance - found.metric.covariance
    assert np.linalg.eigvalsh(gain[:3, :3])[0] > -1e-12
    # Without the levels the declaration is contradicted, and no constraint: that would turn the pose by degrees.
    without = pair_geometry(pair, pose_type="planar", level_sigma_rad=0.0)
    assert without.decision.notes
    assert off(without.metric.cam2_from_cam1) < 0.05


def test_predicted_covariance_holds_in_the_cameras_frames() -> None:
    """Mahalanobis distances of the rotation's errors along the one axis that is free."""
    frames = LevelFrames.from_down(TILTS[0].T[:, 1], TILTS[1].T[:, 1])
    axis = TILTS[1].T[:, 1]
    ratios = []
    for seed in range(16):
        pair, truth = tilted_pair(np.random.default_rng(seed))
        found = pair_geometry(pair, pose_type="planar", level_sigma_rad=0.0, level_frames=frames).metric
        turn = found.cam2_from_cam1.rotation @ truth.rotation.T
        error = np.array([turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]]) / 2.0
        assert np.linalg.norm(error - (error @ axis) * axis) < 1e-9
        ratios.append((error @ axis) ** 2 / (axis @ found.covariance[:3, :3] @ axis))
    assert 0.47 < np.sqrt(np.mean(ratios)) < 1.53  # 16 numbers: known to 18 %; three of that


def test_only_planar_motion_has_level_frames() -> None:
    pair, _ = tilted_pair(np.random.default_rng(0))
    with pytest.raises(InputError, match="planar"):
        pair_geometry(pair, pose_type="standard", level_frames=LevelFrames.from_down([0, 1, 0], [0, 1, 0]))
    with pytest.raises(InputError, match="length zero"):
        LevelFrames.from_down([0.0, 0.0, 0.0], [0.0, 1.0, 0.0])
