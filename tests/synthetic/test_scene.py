"""Boards in space and stereo pairs: positions, angles, visibility, relative poses."""

from __future__ import annotations

import numpy as np
import pytest
from helpers.tolerances import EXACT_REL, ROUNDING

from rigkit.cameras.kannala_brandt import KannalaBrandt
from rigkit.cameras.pinhole import Pinhole
from rigkit.core.boards import Board
from rigkit.core.errors import DegenerateError, InputError
from rigkit.core.posetype import PoseType
from rigkit.geometry.rigid3 import Rigid3, cam_from_world_look_at
from rigkit.geometry.rotation import log_so3, skew
from rigkit.synthetic.pairs import relative_pose, trihedral_pair
from rigkit.synthetic.scene import PlacedBoard, exact_detection, room_walls, trihedral

BOARDS = (Board("plane1", 8, 6, 50.0, 50.0), Board("plane2", 7, 6, 40.0, 42.0), Board("plane3", 6, 9, 45.0, 45.0))
CAMERA = Pinhole((1624, 1240), np.array([1350.0, 1352.0, 805.0, 622.0]))
FISHEYE = KannalaBrandt((960, 720), np.array([352.0, 351.0, 484.0, 356.0, -0.02, 0.001, 0.0, 0.0]))


@pytest.mark.parametrize("angles", [(90.0, 90.0, 90.0), (91.6, 88.0, 93.5), (60.0, 80.0, 100.0), (75.0, 90.0, 100.0)])
def test_planes_stand_at_the_angles_asked_for(angles: tuple[float, float, float]) -> None:
    placed = trihedral(BOARDS, angles_deg=angles)
    normals = [p.normal() for p in placed]
    for (a, b), want in zip(((0, 1), (0, 2), (1, 2)), angles, strict=True):
        assert abs(np.degrees(np.arccos(normals[a] @ normals[b])) - want) < EXACT_REL * 90.0
    for p in placed:
        # Every plane passes through the corner of the room, and its board lies in the room, clear of the seams.
        assert np.abs(p.outline() @ p.normal()).max() < EXACT_REL * 1e3
        assert max((p.outline() @ -q.normal()).max() for q in placed if q is not p) < -2.5
    if angles == (90.0, 90.0, 90.0):
        assert max(p.outline().max() for p in placed) < ROUNDING * 1e3
        for k, p in enumerate(placed):
            others = [i for i in range(3) if i != (2, 1, 0)[k]]
            assert p.outline()[:, others].max() < -2.9


def test_impossible_angles_are_refused() -> None:
    with pytest.raises(InputError, match="no three planes"):
        trihedral(BOARDS, angles_deg=(20.0, 90.0, 150.0))
    with pytest.raises(InputError, match="three boards"):
        trihedral(BOARDS[:2])


def test_walls_lie_behind_the_boards() -> None:
    eye = np.array([-700.0, -600.0, -900.0])
    for placed, wall in zip(trihedral(BOARDS), room_walls(2000.0), strict=True):
        axes = wall.world_from_panel.rotation
        assert np.abs(axes[:, 2] + placed.normal()).max() < ROUNDING
        depth = (wall.world_from_panel.translation_mm - eye) @ axes[:, 2]
        assert abs(depth - (placed.points()[0] - eye) @ axes[:, 2] - 1.0) < EXACT_REL


def test_corners_outside_the_image_or_seen_from_behind_are_left_out() -> None:
    placed = PlacedBoard(BOARDS[0], Rigid3(np.eye(3), [0.0, 0.0, 1000.0]))
    view = exact_detection(placed, CAMERA, Rigid3.identity())
    assert len(view.grid) == 48
    pixels = CAMERA.project(placed.points())[0]
    np.testing.assert_allclose(view.pixels, pixels, rtol=EXACT_REL)
    aside = Rigid3(np.eye(3), [300.0, 0.0, 0.0])
    cut = exact_detection(placed, CAMERA, aside)
    width = CAMERA.size_px[0]
    shifted = CAMERA.project(placed.points() + np.array([300.0, 0.0, 0.0]))[0]
    assert 0 < len(cut.grid) < 48
    assert len(cut.grid) == int((shifted[:, 0] < width - 0.5).sum())
    behind = cam_from_world_look_at((0.0, 0.0, 2000.0), (0.0, 0.0, 1000.0))
    assert not placed.see(CAMERA, behind)[1].any()


@pytest.mark.parametrize("pose_type", [PoseType.GENERAL, PoseType.PLANAR, PoseType.STANDARD, PoseType.FORWARD])
@pytest.mark.parametrize("camera", [CAMERA, FISHEYE], ids=["regular", "fisheye"])
def test_pairs_see_everything_and_move_as_declared(
    pose_type: PoseType, camera: Pinhole | KannalaBrandt, rng: np.random.Generator
) -> None:
    scene = trihedral_pair(BOARDS, camera, pose_type, rng, baseline_mm=150.0)
    first, second = scene.detections()
    assert [d.complete for d in (*first, *second)] == [True] * 6
    move = scene.cam2_from_cam1
    if pose_type is not PoseType.GENERAL:
        assert abs(scene.baseline_mm - 150.0) < EXACT_REL * 150.0
        turned = log_so3(move.rotation)
        assert np.abs(turned[[0, 2]]).max() < EXACT_REL
        assert pose_type is PoseType.PLANAR or abs(turned[1]) < EXACT_REL
        assert abs(move.translation_mm[1]) < EXACT_REL * 150.0
    essential = skew(move.translation_mm) @ move.rotation
    normals = scene.normals_in_cam1()
    for k, (d1, d2, points) in enumerate(zip(first, second, scene.points_in_cam1(), strict=True)):
        rays1, rays2 = camera.unproject(d1.pixels)[0], camera.unproject(d2.pixels)[0]
        residual = np.einsum("ni,ij,nj->n", rays2, essential, rays1)
        assert np.abs(residual).max() < EXACT_REL * 150.0
        np.testing.assert_allclose(np.cross(rays1, points), 0.0, atol=EXACT_REL * 1e3)
        # Unit normals perpendicular to the board, towards the camera.
        assert np.abs((points - points[0]) @ normals[k]).max() < EXACT_REL * 1e3
        assert (points @ normals[k] < 0.0).all()


def test_forward_moves_towards_the_scene_and_standard_to_the_right(rng: np.random.Generator) -> None:
    forward = relative_pose(PoseType.FORWARD, 200.0, rng).inverse().translation_mm
    standard = relative_pose(PoseType.STANDARD, 200.0, rng).inverse().translation_mm
    np.testing.assert_allclose(forward, [0.0, 0.0, 200.0], atol=ROUNDING * 200.0)
    np.testing.assert_allclose(standard, [200.0, 0.0, 0.0], atol=ROUNDING * 200.0)
    with pytest.raises(InputError, match="general"):
        relative_pose(PoseType.GENERAL, 200.0, rng)


def test_a_pair_that_cannot_be_seen_is_refused(rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("rigkit.synthetic.pairs.RANDOM_PAIR_TRIES", 50)
    with pytest.raises(DegenerateError, match="shorter baseline"):
        trihedral_pair(BOARDS, CAMERA, PoseType.STANDARD, rng, baseline_mm=5000.0)


def test_level_error_tilts_the_second_camera_where_it_stands(rng: np.random.Generator) -> None:
    poses = [relative_pose(PoseType.FORWARD, 200.0, rng, level_sigma_deg=0.2) for _ in range(500)]
    tilts = np.degrees([log_so3(pose.rotation) for pose in poses])
    # Relative error of a standard deviation from 1000 samples is 2.2 %.
    assert abs(tilts[:, [0, 2]].std() / 0.2 - 1.0) < 0.07
    assert np.abs(tilts[:, 1]).max() < 1e-9
    np.testing.assert_allclose([p.inverse().translation_mm for p in poses[:5]], [[0, 0, 200.0]] * 5, atol=1e-9)
