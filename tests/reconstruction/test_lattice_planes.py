"""Planes from known lattices: more certain than free ones, honestly so, and undisturbed by what is no corner."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from helpers.board_scenes import detection, fisheye_camera, regular_camera
from helpers.reconstructions import BOARDS

from rigkit.cameras.base import Camera
from rigkit.core.boards import Board
from rigkit.core.posetype import PoseType
from rigkit.reconstruction.geometry import PairGeometry, pair_geometry
from rigkit.reconstruction.lattice_planes import LatticePlanes, lattice_planes
from rigkit.reconstruction.pairing import match_pair
from rigkit.synthetic.pairs import StereoScene, trihedral_pair

SIGMA_PX = 0.03
DRAWS = 30
MAX_RMS_DEG = 0.01
"""Free planes are known to a tenth or two of a degree here; those of known lattices to less than a hundredth."""
WITHIN_ONE, WITHIN_TWO = (0.52, 0.84), (0.88, 1.0)
"""68.3 and 95.4 % for a Gaussian: 90 angles are good to 4.9 and 2.2 %, and three of a scene are correlated."""
PAIRS = (("plane1", "plane2"), ("plane1", "plane3"), ("plane2", "plane3"))


def geometry_of(
    scene: StereoScene, rng: np.random.Generator, sigma_px: float = SIGMA_PX, boards: Sequence[Board] = BOARDS
) -> PairGeometry:
    """Return the geometry of a scene from noisy corners."""
    found = [
        [detection(b, np.array(d.pixels), rng, sigma_px) for b, d in zip(boards, exact, strict=True)]
        for exact in scene.detections()
    ]
    pair = match_pair("made", scene.camera1, scene.camera2, *found, boards)
    return pair_geometry(pair, pose_type=PoseType.GENERAL)


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
    points, covariance = stated.points(boards[0], boards[0].grid())
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
    planes = lattice_planes(geometry, np.outer(step, step), one_camera=True)
    assert planes.calibration_moves.shape[0] == 1
    moved = camera.with_parameters(camera.parameters + step)
    again = lattice_planes(replace(geometry, pair=replace(geometry.pair, camera1=moved, camera2=moved)))
    change = again.cam2_from_cam1.translation_mm - lattice_planes(geometry).cam2_from_cam1.translation_mm
    sign = np.sign(change @ planes.calibration_moves[0, 3:6])
    assert np.linalg.norm(change) > 1e-4
    assert sign * planes.calibration_moves[0, 3:6] == pytest.approx(change, rel=0.02, abs=1e-4)
