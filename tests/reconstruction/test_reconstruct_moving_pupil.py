"""Pairs of a lens with a moving pupil: close corners are corrected, and the pupil's uncertainty is included."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from helpers.board_scenes import fisheye_camera
from helpers.epipolar_scenes import FISHEYE, pair

from rigkit.affine.correspondences import Correspondences
from rigkit.cameras.base import Camera
from rigkit.cameras.moving_pupil import NearCamera
from rigkit.cameras.uncertain import UncertainCamera
from rigkit.core.arrays import FloatArray
from rigkit.core.boards import Board
from rigkit.core.choices import Planes
from rigkit.core.posetype import PoseType
from rigkit.geometry.rotation import angle_between
from rigkit.reconstruction.calibration_shifts import calibration_shifts
from rigkit.reconstruction.geometry import PairGeometry, pair_geometry
from rigkit.reconstruction.pairing import match_pair
from rigkit.reconstruction.reconstruct import fit_planes, reconstruct_from
from rigkit.reconstruction.scene import SceneReconstruction, correct_moving_pupils, reconstruct_scene
from rigkit.synthetic.pairs import StereoScene, trihedral_pair

BOARDS = tuple(Board(name, 8, 6, 10.0, 10.0) for name in ("plane1", "plane2", "plane3"))
NEAR = NearCamera.of(fisheye_camera(), (3.0, -0.3))
SIGMA_MM = 0.005
"""Of the pupil's first term, in the tests of what it does: small, so that corners without noise still fit."""
PART_OF_SHARE = 0.2
"""The share is of first order: how far a pupil's part of a pixel changes with the point, s / distance, is left out."""


@cache
def scene() -> StereoScene:
    rng = np.random.default_rng(3)
    return trihedral_pair(BOARDS, NEAR, PoseType.GENERAL, rng, distance=(0.9, 1.3), walls=False)


@cache
def geometry(camera: Camera) -> PairGeometry:
    return pair_geometry(match_pair("pair", camera, camera, *scene().detections(), BOARDS), pose_type=PoseType.GENERAL)


def off_mm(found: PairGeometry) -> FloatArray:
    """Return how far each corner is from the nearest one that is there, mm: boards that look alike may be exchanged."""
    truth = np.concatenate(scene().points_in_cam1())
    return np.linalg.norm(found.points.points[:, None] - truth, axis=-1).min(axis=1)


def moved_by_one_sigma() -> tuple[UncertainCamera, NearCamera]:
    """The camera with its pupil's first term open, and the camera with that moved."""
    covariance = np.zeros((NEAR.parameters.size,) * 2)
    covariance[-2, -2] = SIGMA_MM**2
    known = UncertainCamera(NEAR, covariance)
    (moved,) = known.moved()
    assert isinstance(moved, NearCamera) and abs(abs(moved.pupil[0] - NEAR.pupil[0]) - SIGMA_MM) < 1e-9
    return known, moved


def test_near_boards_are_reconstructed_with_the_pupil() -> None:
    found = geometry(NEAR)
    assert found.metric.baseline_mm == pytest.approx(scene().baseline_mm, abs=1e-5)
    assert off_mm(found).max() < 1e-4
    assert sum("the entrance pupil of the lens moves" in words for words in found.notes) == 2


def test_near_boards_are_wrong_without_the_pupil() -> None:
    found = geometry(NEAR.lens)
    assert np.median(off_mm(found)) > 0.3 and not any("pupil" in words for words in found.notes)


def test_the_pupil_uncertainty_is_in_the_pose_covariance() -> None:
    known, moved = moved_by_one_sigma()
    r = reconstruct_from(geometry(NEAR))
    shifts = calibration_shifts(r, known)
    there = reconstruct_from(geometry(moved))
    change = there.cloud.points_mm - r.cloud.points_mm
    assert np.abs(change).max() > 2e-3
    np.testing.assert_allclose(shifts.points()[0], change, atol=PART_OF_SHARE * np.abs(change).max())
    baseline = there.baseline_mm - r.baseline_mm
    assert np.sqrt(shifts.variance(lambda one: one.baseline_mm)) == pytest.approx(abs(baseline), rel=PART_OF_SHARE)


@pytest.mark.parametrize("kind", ["coplanar", "lattice"])
def test_the_pupil_uncertainty_is_in_the_planes_of_boards(kind: Planes) -> None:
    known, moved = moved_by_one_sigma()
    here, there = fit_planes(geometry(NEAR), kind, known, one_camera=True), fit_planes(geometry(moved), kind)
    for board in BOARDS:
        turn = here.calibration_moves[0, here.rotation_of(board.board_id)]
        n = here.normal(board.board_id)
        change = there.normal(board.board_id) - n
        assert angle_between(n, there.normal(board.board_id)) > 1e-6
        np.testing.assert_allclose(np.cross(turn, n), change, atol=PART_OF_SHARE * float(np.linalg.norm(change)))


def test_points_of_a_scene_in_mm_say_what_the_pupils_do_to_them(rng: np.random.Generator) -> None:
    clean, pose, points = pair(rng, 120, "general", noise_px=0.05, sigma_A=0.01, camera=FISHEYE)
    # As far away, in movements of the pupil, as near boards are.
    near = NearCamera.of(FISHEYE, (30.0, -3.0))
    moved = [
        at + near.project(p)[0] - FISHEYE.project(p)[0]
        for at, p in ((clean.pixels1, points), (clean.pixels2, pose.apply(points)))
    ]
    found = Correspondences(moved[0], moved[1], clean.A21)
    baseline = float(np.linalg.norm(pose.translation_mm))

    def off(camera: Camera, baseline_mm: float | None) -> tuple[float, SceneReconstruction]:
        def scene_of(one: Correspondences) -> SceneReconstruction:
            return reconstruct_scene(one, FISHEYE, FISHEYE, baseline_mm=baseline_mm)

        scene = correct_moving_pupils(scene_of, found, (camera, camera))
        away = scene.reconstruction.cloud.points_mm - points[scene.kept]
        return float(np.median(np.linalg.norm(away, axis=1))), scene

    (as_central, _), (with_pupil, scene) = off(FISHEYE, baseline), off(near, baseline)
    assert with_pupil < 0.2 * as_central
    assert "entrance pupils move" in scene.reconstruction.notes[0] and len(scene.kept) > 110
    _, without_scale = off(near, None)
    assert not any("pupil" in words for words in without_scale.reconstruction.notes)
