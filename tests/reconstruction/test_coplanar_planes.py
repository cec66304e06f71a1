"""Planes constrained to the points of a board: more accurate than free ones, true sigmas, level priors kept."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from helpers.board_scenes import fisheye_camera, noisy_pair, regular_camera

from rigkit.cameras.base import Camera
from rigkit.cameras.pinhole import Pinhole
from rigkit.cameras.uncertain import UncertainCamera
from rigkit.core.boards import Board
from rigkit.core.errors import DegenerateError, InputError
from rigkit.core.matches import Matches
from rigkit.core.posetype import PoseType
from rigkit.geometry.rotation import angle_between, exp_so3
from rigkit.reconstruction.coplanar_planes import CoplanarPlanes, coplanar_planes
from rigkit.reconstruction.geometry import PairGeometry, pair_geometry
from rigkit.reconstruction.lattice_planes import lattice_planes
from rigkit.reconstruction.pairing import match_pair
from rigkit.reconstruction.reconstruct import fit_planes, on_planes, reconstruct_from, reconstruct_pair
from rigkit.relative_pose.refinement.level_frames import LevelFrames
from rigkit.synthetic.pairs import StereoScene, trihedral_pair
from rigkit.validation.measure import measure

BOARDS = (Board("plane1", 8, 6, 50.0, 50.0), Board("plane2", 7, 6, 50.0, 50.0), Board("plane3", 6, 9, 50.0, 50.0))
PAIRS = (("plane1", "plane2"), ("plane1", "plane3"), ("plane2", "plane3"))
SIGMA_PX = 0.03
DRAWS = 16
WITHIN_ONE, WITHIN_TWO = (0.53, 0.82), (0.88, 1.0)
"""68.3 and 95.4 % for a Gaussian; of 96 normals' tilts or 48 angles, of which three share a scene."""
WITHIN_TWO_OF_BASELINES = 0.85
"""Of 16: four fifths of all such draws have 15 or 16 of them, one in a hundred fewer than 13."""


def geometry_of(scene: StereoScene, rng: np.random.Generator) -> PairGeometry:
    return pair_geometry(noisy_pair(scene, BOARDS, rng, SIGMA_PX), pose_type=PoseType.GENERAL)


def scene_of(camera: Camera, rng: np.random.Generator, pose_type: PoseType = PoseType.GENERAL) -> StereoScene:
    return trihedral_pair(BOARDS, camera, pose_type, rng, distance=(0.9, 1.3), walls=False)


def tilts_in_sigmas(planes: CoplanarPlanes, scene: StereoScene) -> list[float]:
    """Return the error of every normal across either tangent, in its sigma."""
    out: list[float] = []
    for board, true in zip(BOARDS, scene.normals_in_cam1(), strict=True):
        across = np.linalg.svd(np.outer(true, true))[0][:, 1:]
        covariance = across.T @ planes.normal_covariance(board.board_id) @ across
        out += (planes.normal(board.board_id) @ across / np.sqrt(np.diag(covariance))).tolist()
    return out


@pytest.mark.parametrize(
    ("camera", "pose_type"),
    [(regular_camera(), PoseType.GENERAL), (fisheye_camera(), PoseType.FORWARD)],
    ids=["regular general", "fisheye forward"],
)
def test_planes_are_sharper_than_free_ones_and_their_sigmas_honest(
    rng: np.random.Generator, camera: Camera, pose_type: PoseType
) -> None:
    angles, free, tilts, lengths = [], [], [], []
    for _ in range(DRAWS):
        scene = scene_of(camera, rng, pose_type)
        geometry = geometry_of(scene, rng)
        planes = coplanar_planes(geometry)
        measured = measure(reconstruct_from(geometry))
        angles += [planes.angle_deg(a, b) for a, b in PAIRS]
        free += [measured.angle_deg(a, b) for a, b in PAIRS]
        tilts += tilts_in_sigmas(planes, scene)
        length, sigma = planes.baseline_mm()
        lengths.append(abs(length - scene.baseline_mm) / sigma)
    off, sigma_deg = np.array(angles).T
    assert np.sqrt(np.mean((off - 90.0) ** 2)) < 1.02 * np.sqrt(np.mean((np.array(free)[:, 0] - 90.0) ** 2))
    assert np.mean(sigma_deg) < np.mean(np.array(free)[:, 1])
    for k in (np.abs(off - 90.0) / sigma_deg, np.abs(tilts)):
        assert WITHIN_ONE[0] <= np.mean(k < 1.0) <= WITHIN_ONE[1], np.mean(k < 1.0)
        assert WITHIN_TWO[0] <= np.mean(k < 2.0) <= WITHIN_TWO[1], np.mean(k < 2.0)
    assert np.mean(np.array(lengths) < 2.0) >= WITHIN_TWO_OF_BASELINES


def test_exact_corners_give_the_exact_scene(rng: np.random.Generator) -> None:
    scene = scene_of(fisheye_camera(), rng)
    pair = match_pair("made", scene.camera1, scene.camera2, *scene.detections(), BOARDS)
    planes = coplanar_planes(pair_geometry(pair, pose_type="general"))
    assert planes.baseline_mm()[0] == pytest.approx(scene.baseline_mm, rel=1e-9)
    for a, b in PAIRS:
        assert planes.angle_deg(a, b)[0] == pytest.approx(90.0, abs=1e-7)


def test_the_level_holds_as_it_was_declared(rng: np.random.Generator) -> None:
    """Exactly, as a prior between exact and free, and in the frames of tilted cameras as in level ones."""
    scene = scene_of(regular_camera(), rng, PoseType.PLANAR)
    pair = noisy_pair(scene, BOARDS, rng, SIGMA_PX)
    geometries = {
        level: pair_geometry(pair, pose_type=PoseType.PLANAR, level_sigma_rad=level) for level in (0.0, 1e-4, 1.0)
    }
    planes = {level: coplanar_planes(geometry) for level, geometry in geometries.items()}
    poses = {level: own.cam2_from_cam1 for level, own in planes.items()}
    free = coplanar_planes(pair_geometry(pair, pose_type=PoseType.GENERAL)).cam2_from_cam1
    off = {level: abs(pose.rotation[1, 0]) for level, pose in poses.items()}
    assert off[0.0] < 1e-12 < off[1e-4] < off[1.0]
    assert np.allclose(poses[1.0].rotation, free.rotation, atol=1e-7)
    turned, straight = coplanar_planes(_tilted(geometries[1e-4])), planes[1e-4]
    assert turned.baseline_mm()[0] == pytest.approx(straight.baseline_mm()[0], abs=0.2 * straight.baseline_mm()[1])
    for a, b in PAIRS:
        (angle, sigma), (same, _) = straight.angle_deg(a, b), turned.angle_deg(a, b)
        # A pixel of the tilted camera is not the same angle everywhere: its noise weighs a little otherwise.
        assert abs(same - angle) < 0.3 * sigma


def _tilted(geometry: PairGeometry) -> PairGeometry:
    """Return the same corners as cameras tilted about their centres see them, with their levels known."""
    tilt = exp_so3(np.array([0.08, 0.0, -0.05]))
    wide = Pinhole((4000, 4000), np.array([1356.0, 1356.0, 2000.0, 2000.0]))
    identity, camera = geometry.pair.identity, geometry.pair.camera1
    one, two = (
        [replace(d, pixels=wide.project(camera.unproject(d.pixels)[0] @ tilt)[0]) for d in found]
        for found in (identity.detections1, identity.detections2)
    )
    pair = match_pair("tilted", wide, wide, one, two, BOARDS)
    down = tilt.T[:, 1]
    frames = LevelFrames.from_down(down, down)
    return pair_geometry(pair, pose_type=PoseType.PLANAR, level_sigma_rad=1e-4, level_frames=frames)


def test_calibration_moves_are_those_of_a_new_fit(rng: np.random.Generator) -> None:
    scene = scene_of(regular_camera(), rng)
    geometry = geometry_of(scene, rng)
    step = np.zeros(len(scene.camera1.parameters))
    step[0] = 0.05
    planes = coplanar_planes(geometry, UncertainCamera(scene.camera1, np.outer(step, step)), one_camera=True)
    exact = coplanar_planes(geometry)
    moved = scene.camera1.with_parameters(scene.camera1.parameters + step)
    pair = replace(geometry.pair, camera1=moved, camera2=moved, captured=_seen(geometry, moved))
    again = coplanar_planes(replace(geometry, pair=pair))
    change = again.cam2_from_cam1.translation_mm - exact.cam2_from_cam1.translation_mm
    assert np.linalg.norm(change) > 1e-4
    sign = np.sign(change @ planes.calibration_moves[0, 3:6])
    # The boards' scales are weighted anew there, which the linear share leaves as they are.
    assert sign * planes.calibration_moves[0, 3:6] == pytest.approx(change, rel=0.05, abs=1e-3)
    assert planes.angle_deg("plane1", "plane2")[1] > exact.angle_deg("plane1", "plane2")[1]
    grid = BOARDS[0].grid().astype(np.float64)
    whole, own = (np.trace(p.points(BOARDS[0], grid)[1], axis1=1, axis2=2) for p in (planes, exact))
    assert (whole > own).all()


def _seen(geometry: PairGeometry, camera: Camera, pixels2: np.ndarray | None = None) -> Matches:
    """Return the captured matches through another camera, or with other pixels in the second image."""
    m = geometry.pair.captured
    return Matches.from_cameras(
        camera,
        camera,
        m.pixels1,
        m.pixels2 if pixels2 is None else pixels2,
        sigma1_px=m.sigma1_px,
        sigma2_px=m.sigma2_px,
        board_index=m.board_index,
        grid=m.grid,
    )


def test_a_corner_that_is_none_is_left_out_of_fit_and_cloud(rng: np.random.Generator) -> None:
    scene = scene_of(regular_camera(), rng)
    geometry = geometry_of(scene, rng)
    m = geometry.pair.captured
    pixels = np.array(m.pixels2)
    row = int(np.flatnonzero(m.board_index == 1)[10])
    pixels[row] += [1.5, -2.0]
    captured = _seen(geometry, scene.camera1, pixels)
    planes = coplanar_planes(replace(geometry, pair=replace(geometry.pair, captured=captured)))
    assert planes.gross == 1
    assert np.abs(tilts_in_sigmas(planes, scene)).max() < 4.5
    cloud = on_planes(reconstruct_from(geometry), planes).cloud
    assert len(cloud) == planes.count == len(m) - 1


def test_a_cloud_lies_on_its_planes(rng: np.random.Generator) -> None:
    geometry = geometry_of(scene_of(regular_camera(), rng), rng)
    planes = fit_planes(geometry, "coplanar")
    made = on_planes(reconstruct_from(geometry), planes)
    for n, board in enumerate(made.boards):
        own = made.cloud.board_index == n
        middle = planes.points(board, made.cloud.grid[own])[0].mean(axis=0)
        distances = (made.cloud.points_mm[own] - middle) @ planes.normal(board.board_id)
        assert own.sum() == board.corner_count
        assert np.abs(distances).max() < 1e-9
        assert angle_between(made.cloud.normals[own], planes.normal(board.board_id)).max() < 1e-7
    assert made.baseline_mm == planes.baseline_mm()[0]
    again = reconstruct_pair(geometry.pair, pose_type="general", planes="coplanar")
    assert again.baseline_mm == pytest.approx(made.baseline_mm, rel=1e-5)
    # The lattice knows more than the plane does, so it is the sharper.
    assert lattice_planes(geometry).angle_deg(*PAIRS[0])[1] < planes.angle_deg(*PAIRS[0])[1]


def test_too_few_corners_and_free_planes_are_refused(rng: np.random.Generator) -> None:
    geometry = geometry_of(scene_of(regular_camera(), rng), rng)
    with pytest.raises(InputError, match="free"):
        fit_planes(geometry, "free")
    few = geometry.pair.captured.select(np.arange(0, len(geometry.pair.captured), 8))
    with pytest.raises(DegenerateError, match="8 corners"):
        coplanar_planes(replace(geometry, pair=replace(geometry.pair, captured=few)))
