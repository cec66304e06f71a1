"""Boards of a pair: the same physical corner gets the same index in both images, or ambiguity is reported."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from helpers.board_scenes import (
    LAB_PAIRS,
    Scene,
    both_views,
    detection,
    fisheye_camera,
    lab_scene,
    regular_camera,
    scrambled,
    trihedral_scene,
    true_corners,
    view,
)
from helpers.data import shared_data

from rigkit.cameras.pinhole import Pinhole
from rigkit.core.boards import Board
from rigkit.core.detections import BoardDetection, common_corners
from rigkit.core.errors import DegenerateError, InputError
from rigkit.geometry.rigid3 import Rigid3
from rigkit.geometry.rotation import exp_so3, rotation_angle
from rigkit.identification.identify import PairIdentity, identify_pair

POSE_RAD = 2e-3
"""0.05 px at 1356 px over three boards gives about 1e-4 rad; a wrong assignment is off by tens of degrees."""
NOISE_PX = 0.05
RMS_BAND = (0.9, 1.1)
"""144 corners in two images: the rms of the residuals is the noise within a few per cent, parameters included."""

EQUAL = tuple(Board(i, 8, 6, 50.0, 50.0) for i in "abc")
MIXES = {
    "all different": ((9, 6), (8, 6), (7, 6)),
    "two equal": ((8, 6), (8, 6), (7, 5)),
    "equal, one listed upright": ((8, 6), (6, 8), (7, 6)),
    "equal with a unique origin": ((9, 6), (9, 6), (9, 6)),
    "square, odd": ((7, 7), (7, 7), (7, 7)),
    "square, even": ((6, 6), (6, 6), (6, 6)),
}


def assert_right(identity: PairIdentity, scene: Scene, count: int) -> None:
    """Every pair of detections shows one board, corner by corner, and the pose is the true one."""
    assert len(identity.pairs()) == count
    for one, two in identity.pairs():
        board1, corners1 = true_corners(one, scene.pixels1)
        board2, corners2 = true_corners(two, scene.pixels2)
        assert board1 == board2
        _, first, second = common_corners(one, two)
        assert np.array_equal(corners1[first], corners2[second])
    turn = identity.cam2_from_cam1.rotation @ scene.cam2_from_cam1.rotation.T
    assert rotation_angle(turn) < POSE_RAD


@pytest.mark.real
@pytest.mark.parametrize("name", LAB_PAIRS)
@pytest.mark.parametrize("sigma_px", [0.0, 0.3])
def test_kept_captures(name: str, sigma_px: float, rng: np.random.Generator) -> None:
    scene = lab_scene(name)
    one, two = both_views(scene, rng, sigma_px)
    identity = identify_pair(one, two, scene.boards, scene.camera1, scene.camera2)
    assert_right(identity, scene, 3)
    assert not identity.ambiguous and not identity.missing
    # The captures call the right wall plane1, the floor plane2, the left wall plane3: the rule's order.
    assert [true_corners(d, scene.pixels1)[0] for d in identity.detections1] == ["plane1", "plane2", "plane3"]
    truth = json.loads((shared_data("lab-a") / "captures" / name / "truth.json").read_text())
    for board_id, normal in truth["plane_normals_cam1"].items():
        assert -identity.cam1_from_board[board_id].rotation[:, 2] @ normal > np.cos(0.01)


@pytest.mark.parametrize("camera", [regular_camera(), fisheye_camera()], ids=["regular", "fisheye"])
def test_three_equal_boards_in_random_corners(camera: object, rng: np.random.Generator) -> None:
    for _ in range(12):
        scene = trihedral_scene(rng, EQUAL, camera)  # type: ignore[arg-type]
        identity = identify_pair(*both_views(scene, rng, NOISE_PX), EQUAL, camera, camera)  # type: ignore[arg-type]
        assert_right(identity, scene, 3)
        assert not identity.ambiguous
        assert RMS_BAND[0] < identity.residual_px / (NOISE_PX * np.sqrt(2.0)) < RMS_BAND[1]


@pytest.mark.slow
def test_three_equal_boards_in_400_random_corners(rng: np.random.Generator) -> None:
    for k in range(400):
        camera = (regular_camera(), fisheye_camera())[k % 2]
        scene = trihedral_scene(rng, EQUAL, camera)
        identity = identify_pair(*both_views(scene, rng, NOISE_PX), EQUAL, camera, camera)
        if not identity.ambiguous:
            assert_right(identity, scene, 3)


@pytest.mark.parametrize("sizes", MIXES.values(), ids=MIXES)
def test_mixes_of_boards(sizes: tuple[tuple[int, int], ...], rng: np.random.Generator) -> None:
    boards = tuple(Board(i, *size, 40.0, 40.0) for i, size in zip("abc", sizes, strict=True))
    for _ in range(2):
        scene = trihedral_scene(rng, boards, fisheye_camera())
        one, two = both_views(scene, rng, NOISE_PX)
        if sizes[0] == (7, 7):
            one = [d.turned(int(rng.integers(4))) for d in one]
        identity = identify_pair(one, two, boards, scene.camera1, scene.camera2)
        assert_right(identity, scene, 3)
        assert not identity.ambiguous
        for board, found in zip(boards, identity.detections1, strict=True):
            assert (found.board_id, found.columns, found.rows) == (board.board_id, board.columns, board.rows)
            if len({tuple(sorted(s)) for s in sizes}) == 3:
                assert true_corners(found, scene.pixels1)[0] == board.board_id


def test_an_imperfect_calibration_changes_residuals_not_answers(rng: np.random.Generator) -> None:
    for _ in range(5):
        scene = trihedral_scene(rng, EQUAL, regular_camera())
        off = scene.camera1.with_parameters(scene.camera1.parameters * [1.01, 1.015, 1.02, 0.98])
        identity = identify_pair(*both_views(scene, rng, NOISE_PX), EQUAL, off, off)
        assert [true_corners(a, scene.pixels1)[0] for a, _ in identity.pairs()] == [
            true_corners(b, scene.pixels2)[0] for _, b in identity.pairs()
        ]
        assert not identity.ambiguous
        assert identity.residual_px > 2.0 * NOISE_PX


def symmetric_scene(rng: np.random.Generator, shift_mm: float) -> Scene:
    """Three equal boards that a third of a turn about the corner's diagonal maps onto each other, but for a shift."""
    third = Rigid3(exp_so3(np.array([1.0, -1.0, 1.0]) / np.sqrt(3.0) * 2.0 * np.pi / 3.0), np.zeros(3))
    camera = fisheye_camera()
    for _ in range(1000):
        scene = trihedral_scene(rng, EQUAL[:1], camera)
        assert scene.cam1_from_world is not None
        world_from_board = scene.cam1_from_world.inverse() @ scene.cam1_from_board["a"]
        poses = {}
        for board in EQUAL:
            shift = Rigid3(np.eye(3), rng.normal(size=3) * shift_mm)
            poses[board.board_id] = scene.cam1_from_world @ shift @ world_from_board
            world_from_board = third @ world_from_board
        pixels1 = view(EQUAL, camera, poses)
        pixels2 = view(EQUAL, camera, {k: scene.cam2_from_cam1 @ v for k, v in poses.items()})
        if all(np.isfinite(p).all() for p in [*pixels1.values(), *pixels2.values()]):
            return Scene(EQUAL, camera, camera, poses, scene.cam2_from_cam1, pixels1, pixels2)
    raise AssertionError("no symmetric scene fits into the image")


def test_a_symmetric_arrangement_is_called_ambiguous(rng: np.random.Generator) -> None:
    for _ in range(5):
        scene = symmetric_scene(rng, 0.0)
        identity = identify_pair(*both_views(scene, rng, NOISE_PX), EQUAL, scene.camera1, scene.camera2)
        assert identity.ambiguous
        assert "smallest roll" in " ".join(identity.notes)


def test_a_slightly_unsymmetric_arrangement_is_told(rng: np.random.Generator) -> None:
    """Two millimetres are several times the corner noise: enough to be sure, and right."""
    for _ in range(5):
        scene = symmetric_scene(rng, 2.0)
        identity = identify_pair(*both_views(scene, rng, NOISE_PX), EQUAL, scene.camera1, scene.camera2)
        assert not identity.ambiguous
        assert_right(identity, scene, 3)


def test_one_board_alone(rng: np.random.Generator) -> None:
    """One board that looks the same turned is a tie, broken by the roll; one that does not is none."""
    scene = trihedral_scene(rng, EQUAL[:1], regular_camera())
    identity = identify_pair(*both_views(scene, rng), EQUAL[:1], scene.camera1, scene.camera2)
    assert_right(identity, scene, 1)
    assert identity.ambiguous
    unique = (Board("u", 9, 6, 40.0, 40.0),)
    scene = trihedral_scene(rng, unique, regular_camera())
    identity = identify_pair(*both_views(scene, rng), unique, scene.camera1, scene.camera2)
    assert_right(identity, scene, 1)
    assert not identity.ambiguous


@pytest.mark.parametrize(("side", "roll_rad", "turns"), [(7, 1.4, 0), (6, 0.3, 1)])
def test_colour_goes_before_roll_on_an_odd_square(
    side: int, roll_rad: float, turns: int, rng: np.random.Generator
) -> None:
    """A quarter turn exchanges the colours of 8x8 squares, 7x7 corners: a camera rolled by 80 degrees is not mistaken.

    It leaves 7x7 squares as they are, whose grids so start at any corner: there the smaller roll decides.
    """
    boards = (Board("s", side, side, 40.0, 40.0),)
    roll = Rigid3(exp_so3(np.array([0.0, 0.0, roll_rad])), np.zeros(3))
    for _ in range(100):
        scene = trihedral_scene(rng, boards, regular_camera())
        poses = {"s": roll @ scene.cam1_from_board["s"]}
        rolled = replace(scene, pixels2=view(boards, scene.camera1, poses), cam2_from_cam1=roll)
        if np.isfinite(rolled.pixels2["s"]).all():
            break
    one, two = both_views(rolled, rng)
    identity = identify_pair(one, [d.turned(turns) for d in two], boards, scene.camera1, scene.camera2)
    assert_right(identity, rolled, 1)
    assert identity.ambiguous


def test_a_board_in_one_image_only(rng: np.random.Generator) -> None:
    scene = trihedral_scene(rng, EQUAL, regular_camera())
    one, two = both_views(scene, rng)
    identity = identify_pair(one, two[:2], EQUAL, scene.camera1, scene.camera2)
    assert_right(identity, scene, 2)
    assert not identity.ambiguous
    (lost,) = identity.missing
    assert "image 1 only" in identity.missing[lost]
    assert [d.board_id for d in identity.detections1][-1] == lost and len(identity.detections2) == 2
    swapped = identify_pair(one[:2], two, EQUAL, scene.camera1, scene.camera2)
    assert_right(swapped, scene, 2)
    # The board of image 2 is placed in camera 1 through the relative pose.
    (lost,) = swapped.missing
    seen, _ = true_corners(swapped.detections2[-1], scene.pixels2)
    centre = EQUAL[0].points().mean(axis=0)
    error = swapped.cam1_from_board[lost].apply(centre) - scene.cam1_from_board[seen].apply(centre)
    assert np.linalg.norm(error) < 5.0


def test_boards_that_are_not_listed_are_left_out_and_said(rng: np.random.Generator) -> None:
    scene = trihedral_scene(rng, EQUAL, regular_camera())
    one, two = both_views(scene, rng)
    stranger = Board("z", 5, 4, 30.0, 30.0)
    pixels = stranger.points()[:, :2] + 100.0
    identity = identify_pair([*one, detection(stranger, pixels)], two, EQUAL, scene.camera1, scene.camera2)
    assert_right(identity, scene, 3)
    assert any("5x4" in note for note in identity.notes)
    fewer = identify_pair(one, two, EQUAL[:2], scene.camera1, scene.camera2)
    assert_right(fewer, scene, 2)
    assert sum("one too many" in note for note in fewer.notes) == 2
    # A second detection of a part of a board, as after a failed merge.
    twice = identify_pair([*one, cut(one[0], slice(0, 4), slice(0, 4))], two, EQUAL, scene.camera1, scene.camera2)
    assert_right(twice, scene, 3)
    assert len(twice.detections1) == 3
    # One detection is one board, even if there are boards left to be.
    more = (*EQUAL, Board("d", 8, 6, 50.0, 50.0))
    again = identify_pair([*one, one[0]], two, more, scene.camera1, scene.camera2)
    assert_right(again, scene, 3)
    assert [(len(again.detections1), len(again.detections2)), len(again.missing)] == [(4, 3), 1]


def test_a_board_that_moved_is_left_out_and_said(rng: np.random.Generator) -> None:
    scene = trihedral_scene(rng, EQUAL, regular_camera())
    moved = scene.cam2_from_cam1 @ scene.cam1_from_board["c"] @ Rigid3(np.eye(3), np.array([70.0, 0.0, 0.0]))
    pixels2 = {**scene.pixels2, "c": scene.camera2.project(moved.apply(EQUAL[2].points()))[0]}
    one = [detection(b, scene.pixels1[b.board_id], rng, NOISE_PX) for b in EQUAL]
    two = [detection(b, pixels2[b.board_id], rng, NOISE_PX) for b in EQUAL]
    identity = identify_pair(scrambled(one, rng), scrambled(two, rng), EQUAL, scene.camera1, scene.camera2)
    assert_right(identity, scene, 2)
    assert any("moved" in note for note in identity.notes)


def test_corners_without_a_ray_are_left_out_and_said(rng: np.random.Generator) -> None:
    scene = trihedral_scene(rng, EQUAL, regular_camera())
    one, two = both_views(scene, rng)
    edge = float(np.sort(np.concatenate([d.pixels[:, 0] for d in one]))[-5])
    narrow = HalfBlind(scene.camera1.size_px, scene.camera1.parameters)
    HalfBlind.limit_px = edge
    identity = identify_pair(one, two, EQUAL, narrow, scene.camera2)
    assert_right(identity, scene, 3)
    assert any("field of view" in note for note in identity.notes)
    assert sum(len(d.grid) for d in identity.detections1) == 3 * 48 - 5


class HalfBlind(Pinhole):
    """A camera whose calibration ends at a column of the image."""

    limit_px = np.inf

    def unproject(self, pixels: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        rays, valid = Pinhole.unproject(self, pixels)
        valid = valid & (np.asarray(pixels)[..., 0] < self.limit_px)
        return np.where(valid[..., None], rays, np.nan), valid


def test_two_identical_images(rng: np.random.Generator) -> None:
    scene = trihedral_scene(rng, EQUAL, fisheye_camera())
    one, _ = both_views(scene, rng)
    still = replace(scene, pixels2=scene.pixels1, cam2_from_cam1=Rigid3.identity())
    identity = identify_pair(one, scrambled(one, rng), EQUAL, scene.camera1, scene.camera1)
    assert_right(identity, still, 3)
    assert np.linalg.norm(identity.cam2_from_cam1.translation_mm) < 1e-6


def cut(found: BoardDetection, columns: slice, rows: slice, *, keeps_place: bool = False) -> BoardDetection:
    """What a detector reports of a board cut by the frame or a hand."""
    column, row = found.grid.T
    keep = np.isin(column, np.arange(found.columns)[columns]) & np.isin(row, np.arange(found.rows)[rows])
    start = np.zeros(2, int) if keeps_place else found.grid[keep].min(axis=0)
    grid = found.grid[keep] - start
    size = (found.columns, found.rows) if keeps_place else grid.max(axis=0) + 1
    return BoardDetection(None, int(size[0]), int(size[1]), grid, found.pixels[keep], found.sigma_px[keep])


@pytest.mark.parametrize("keeps_place", [False, True])
def test_partial_boards(keeps_place: bool, rng: np.random.Generator) -> None:
    """Parts of boards find their place on the board from the other boards."""
    scene = trihedral_scene(rng, EQUAL, regular_camera())
    one, two = both_views(scene, rng)
    one[0] = cut(one[0], slice(0, 7), slice(1, 6), keeps_place=keeps_place)
    two[1] = cut(two[1], slice(2, 8), slice(0, 6), keeps_place=keeps_place)
    two[2] = cut(two[2], slice(0, 8), slice(2, 6), keeps_place=keeps_place)
    identity = identify_pair(one, two, EQUAL, scene.camera1, scene.camera2)
    assert_right(identity, scene, 3)
    assert not identity.ambiguous
    assert all((d.columns, d.rows) == (8, 6) for d in identity.detections1 + identity.detections2)
    assert min(len(common_corners(a, b)[0]) for a, b in identity.pairs()) >= 20


def test_names_that_are_given_are_kept(rng: np.random.Generator) -> None:
    scene = trihedral_scene(rng, EQUAL, regular_camera())
    one = [detection(b, scene.pixels1[b.board_id], named=True) for b in EQUAL]
    two = [detection(b, scene.pixels2[b.board_id]) for b in EQUAL]
    identity = identify_pair(one, two, EQUAL, scene.camera1, scene.camera2)
    assert_right(identity, scene, 3)
    assert [true_corners(d, scene.pixels2)[0] for d in identity.detections2] == ["a", "b", "c"]
    # Names that contradict the geometry join nothing.
    wrong = [two[0].named("a"), two[1].named("c"), two[2].named("b")]
    identity = identify_pair(one, wrong, EQUAL, scene.camera1, scene.camera2)
    assert all(a.board_id == b.board_id for a, b in identity.pairs())
    assert len(identity.pairs()) == 1
    with pytest.raises(InputError, match="called 'a'"):
        identify_pair([one[0], one[1].named("a")], two, EQUAL, scene.camera1, scene.camera2)


def test_nothing_in_common_and_bad_lists(rng: np.random.Generator) -> None:
    scene = trihedral_scene(rng, EQUAL[:1], regular_camera())
    one, two = both_views(scene, rng)
    with pytest.raises(DegenerateError, match="both images"):
        identify_pair(one, [], EQUAL, scene.camera1, scene.camera2)
    with pytest.raises(DegenerateError, match="both images"):
        identify_pair(one, two, [Board("small", 5, 4, 30.0, 30.0)], scene.camera1, scene.camera2)
    with pytest.raises(InputError, match="no boards"):
        identify_pair(one, two, [], scene.camera1, scene.camera2)
    with pytest.raises(InputError, match="twice"):
        identify_pair(one, two, [EQUAL[0], EQUAL[0]], scene.camera1, scene.camera2)
