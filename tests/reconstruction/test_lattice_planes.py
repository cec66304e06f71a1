"""Planes from known lattices: more certain than free ones, with true sigmas, robust to false corners."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from helpers.board_scenes import fisheye_camera, noisy_pair, regular_camera
from helpers.reconstructions import BOARDS

from rigkit.cameras.base import Camera
from rigkit.cameras.uncertain import UncertainCamera
from rigkit.core.boards import Board
from rigkit.core.errors import DegenerateError
from rigkit.core.posetype import PoseType
from rigkit.geometry.rotation import angle_between
from rigkit.io.ply import read_ply, write_ply
from rigkit.reconstruction.geometry import PairGeometry, pair_geometry
from rigkit.reconstruction.lattice_planes import LatticePlanes, lattice_planes
from rigkit.reconstruction.reconstruct import on_planes, reconstruct_from
from rigkit.relative_pose.solvers.pose import essential_from_pose
from rigkit.synthetic.pairs import StereoScene, trihedral_pair

SIGMA_PX = 0.03
DRAWS = 18
CLOUDS = 12
MEAN_OVER_SIGMA = (0.45, 1.4)
"""Root mean square error over sigma of 36 boards, three of a scene correlated: 1 for normals within 4 standard
deviations of about 0.12; sigmas of points are those along their worst axis and so on the large side."""
MAX_RMS_DEG = 0.01
"""Free planes are known to a tenth or two of a degree here; those of known lattices to less than a hundredth."""
WITHIN_ONE, WITHIN_TWO = (0.52, 0.84), (0.88, 1.0)
"""68.3 and 95.4 % for a Gaussian: 54 angles are good to 6.3 and 2.9 %, and three of a scene are correlated."""
PAIRS = (("plane1", "plane2"), ("plane1", "plane3"), ("plane2", "plane3"))


def geometry_of(
    scene: StereoScene, rng: np.random.Generator, sigma_px: float = SIGMA_PX, boards: Sequence[Board] = BOARDS
) -> PairGeometry:
    """Return the geometry of a scene from noisy corners."""
    return pair_geometry(noisy_pair(scene, boards, rng, sigma_px), pose_type=PoseType.GENERAL)


def scene_of(camera: Camera, pose_type: PoseType, rng: np.random.Generator) -> StereoScene:
    return trihedral_pair(BOARDS, camera, pose_type, rng, distance=(0.9, 1.3), walls=False)


def errors(planes: LatticePlanes) -> list[tuple[float, float]]:
    """Return (error, sigma) of every angle, deg."""
    return [(angle - 90.0, sigma) for angle, sigma in (planes.angle_deg(a, b) for a, b in PAIRS)]


@pytest.mark.parametrize(
    ("camera", "pose_type"),
    [(regular_camera(), PoseType.FORWARD), (fisheye_camera(), PoseType.GENERAL)],
    ids=["regular forward", "fisheye general"],
)
def test_angles_are_sharp_and_their_sigmas_honest(
    rng: np.random.Generator, camera: Camera, pose_type: PoseType
) -> None:
    found, lengths = [], []
    for _ in range(DRAWS):
        scene = scene_of(camera, pose_type, rng)
        planes = lattice_planes(geometry_of(scene, rng))
        assert planes.gross == 0
        found += errors(planes)
        length, sigma = planes.baseline_mm()
        lengths.append(abs(length - scene.baseline_mm) / sigma)
    off, sigma_deg = np.array(found).T
    k = np.abs(off) / sigma_deg
    assert np.sqrt(np.mean(off**2)) < MAX_RMS_DEG
    assert WITHIN_ONE[0] <= np.mean(k < 1.0) <= WITHIN_ONE[1], np.mean(k < 1.0)
    assert WITHIN_TWO[0] <= np.mean(k < 2.0) <= WITHIN_TWO[1], np.mean(k < 2.0)
    assert np.mean(np.array(lengths) < 2.0) >= 0.85


def test_the_sigma_follows_what_the_corners_show(rng: np.random.Generator) -> None:
    """The stated sigma is a third of the true one: the residuals tell."""
    scene = scene_of(regular_camera(), PoseType.GENERAL, rng)
    geometry = geometry_of(scene, rng, 3.0 * SIGMA_PX)
    assert lattice_planes(geometry).angle_deg("plane1", "plane2")[1] == pytest.approx(
        3.0 * lattice_planes(geometry_of(scene, rng)).angle_deg("plane1", "plane2")[1], rel=0.25
    )


def test_a_corner_that_is_none_is_left_out(rng: np.random.Generator) -> None:
    scene = scene_of(regular_camera(), PoseType.GENERAL, rng)
    geometry = geometry_of(scene, rng)
    identity = geometry.pair.identity
    first = identity.detections1[0]
    pixels = np.array(first.pixels)
    pixels[11] += [2.0, -1.5]
    spoilt = replace(identity, detections1=(replace(first, pixels=pixels), *identity.detections1[1:]))
    planes = lattice_planes(replace(geometry, pair=replace(geometry.pair, identity=spoilt)))
    assert planes.gross == 1
    assert all(abs(off) < 5.0 * sigma for off, sigma in errors(planes))


def test_the_squares_sigma_moves_lengths_and_not_angles(rng: np.random.Generator) -> None:
    boards = tuple(replace(b, square_sigma_mm=0.001 * b.square_x_mm) for b in BOARDS)
    scene = scene_of(regular_camera(), PoseType.GENERAL, rng)
    exact, stated = (lattice_planes(geometry_of(scene, np.random.default_rng(5), boards=b)) for b in (BOARDS, boards))
    assert stated.angle_deg("plane1", "plane2")[1] < 1.5 * exact.angle_deg("plane1", "plane2")[1]
    # Three boards, each with its own ruler: the common size is known to a thousandth over the root of three.
    assert stated.baseline_mm()[1] == pytest.approx(0.001 * scene.baseline_mm / np.sqrt(3.0), rel=0.2)
    points, covariance = stated.points(boards[0], boards[0].grid().astype(np.float64))
    assert points.shape == (boards[0].corner_count, 3)
    assert np.linalg.norm(points - points[0], axis=1).max() == pytest.approx(
        np.linalg.norm(boards[0].points(), axis=1).max(), rel=1e-9
    )
    assert (np.linalg.eigvalsh(covariance)[:, -1] > 0.0).all()


def test_calibration_moves_are_those_of_a_new_fit(rng: np.random.Generator) -> None:
    """The linear share of the calibration equals the difference of two fits with cameras a little apart."""
    scene = scene_of(regular_camera(), PoseType.GENERAL, rng)
    geometry = geometry_of(scene, rng)
    camera = scene.camera1
    step = np.zeros(len(camera.parameters))
    step[0] = 0.05
    planes = lattice_planes(geometry, UncertainCamera(camera, np.outer(step, step)), one_camera=True)
    assert planes.calibration_moves.shape[0] == 1
    moved = camera.with_parameters(camera.parameters + step)
    again = lattice_planes(replace(geometry, pair=replace(geometry.pair, camera1=moved, camera2=moved)))
    change = again.cam2_from_cam1.translation_mm - lattice_planes(geometry).cam2_from_cam1.translation_mm
    sign = np.sign(change @ planes.calibration_moves[0, 3:6])
    assert np.linalg.norm(change) > 1e-4
    assert sign * planes.calibration_moves[0, 3:6] == pytest.approx(change, rel=0.02, abs=1e-4)


def test_a_cloud_on_the_lattices_is_where_its_sigmas_say(rng: np.random.Generator) -> None:
    """Points miss the truth by what their sigmas say, normals too; both far less than those of free points."""
    k_points, k_normals, gains = [], [], []
    for _ in range(CLOUDS):
        scene = scene_of(fisheye_camera(), PoseType.GENERAL, rng)
        free = reconstruct_from(geometry_of(scene, rng))
        assert free.geometry is not None
        made = on_planes(free, lattice_planes(free.geometry))
        assert pytest.approx(essential_from_pose(made.cam2_from_cam1)) == made.E21
        # Boards look alike and may be counted from either end: the nearest true corner is the one meant.
        poses = [scene.cam1_from_world @ placed.world_from_board for placed in scene.boards]
        exact = np.array([pose.apply(board.points()) for pose, board in zip(poses, BOARDS, strict=True)])
        for k in range(len(BOARDS)):
            at = [c.board_index == k for c in (made.cloud, free.cloud)]
            far = np.linalg.norm(made.cloud.points_mm[at[0]][:, None, None] - exact, axis=3)
            k_points.append(np.mean(far.min(axis=(1, 2)) / made.cloud.sigma_mm[at[0]]))
            normal = -poses[int(far[0].min(axis=1).argmin())].rotation[:, 2]
            angle, free_angles = (
                angle_between(c.normals[m], normal) for c, m in zip((made.cloud, free.cloud), at, strict=True)
            )
            k_normals.append(angle[0] / made.cloud.normal_sigma_rad[at[0]][0])
            gains.append(np.median(free_angles) / angle[0])
    assert MEAN_OVER_SIGMA[0] < np.sqrt(np.mean(np.square(k_points))) < MEAN_OVER_SIGMA[1]
    assert MEAN_OVER_SIGMA[0] < np.sqrt(np.mean(np.square(k_normals))) < MEAN_OVER_SIGMA[1]
    assert np.median(gains) > 3.0


def test_a_cloud_on_the_lattices_says_what_its_sigmas_include(rng: np.random.Generator, tmp_path: Path) -> None:
    scene = scene_of(regular_camera(), PoseType.GENERAL, rng)
    free = reconstruct_from(geometry_of(scene, rng))
    assert free.geometry is not None
    step = 1e-3 * np.abs(scene.camera1.parameters)
    known = UncertainCamera(scene.camera1, np.outer(step, step))
    planes = [lattice_planes(free.geometry, c, one_camera=True) for c in (None, known)]
    exact, whole = (on_planes(free, one).cloud for one in planes)
    assert (whole.sigma_mm > exact.sigma_mm).all()
    assert (whole.normal_sigma_rad > exact.normal_sigma_rad).all()
    for name, cloud, declared in (("exact", exact, False), ("whole", whole, True)):
        write_ply(tmp_path / f"{name}.ply", cloud)
        assert cloud.calibration_in_sigmas == read_ply(tmp_path / f"{name}.ply").calibration_in_sigmas == declared
        header = (tmp_path / f"{name}.ply").read_bytes().split(b"end_header")[0]
        assert (b"covariance of the calibrations" in header) == declared


def test_points_of_boards_without_a_fit_are_left_out(rng: np.random.Generator) -> None:
    free = reconstruct_from(geometry_of(scene_of(regular_camera(), PoseType.GENERAL, rng), rng))
    assert free.geometry is not None
    planes = lattice_planes(free.geometry)
    part = on_planes(free, replace(planes, board_ids=("plane1", "other", "more")))
    assert len(part.cloud) == len(part.matches) == len(part.pixels1) == (free.cloud.board_index == 0).sum()
    assert "plane2, plane3" in part.notes[-1]
    with pytest.raises(DegenerateError, match="no point is on a board"):
        on_planes(free, replace(planes, board_ids=("x", "y", "z")))
