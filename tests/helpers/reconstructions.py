"""Exact reconstructions of three boards on faces at given angles, seen by two cameras."""

from __future__ import annotations

import numpy as np

from rigkit.cameras.base import Camera
from rigkit.cameras.pinhole import Pinhole
from rigkit.core.boards import Board
from rigkit.core.cloud import OrientedCloud
from rigkit.core.matches import Matches
from rigkit.core.posetype import PoseType
from rigkit.geometry.rigid3 import Rigid3
from rigkit.geometry.rotation import exp_so3, skew, unit
from rigkit.reconstruction.reconstruct import Reconstruction

BOARDS = tuple(Board(name, 8, 6, 50.0, 50.0) for name in ("plane1", "plane2", "plane3"))
CAM2_FROM_CAM1 = Rigid3(exp_so3(np.array([0.05, -0.25, 0.08])), np.array([280.0, 60.0, 80.0]))


def trihedral_poses(boards: tuple[Board, ...] = BOARDS, angles_deg: tuple[float, ...] = (90.0, 90.0, 90.0)) -> list:
    """cam1_from_board of three boards whose faces are at `angles_deg` (1-2, 1-3, 2-3)."""
    cosines = -np.cos(np.deg2rad(angles_deg))
    gram = np.eye(3)
    gram[0, 1], gram[0, 2], gram[1, 2] = cosines
    normals = np.linalg.cholesky(gram + np.triu(gram, 1).T)
    middle = unit(normals.sum(axis=0))
    turn = unit(np.cross(middle, [0.0, 0.0, -1.0]))
    angle = np.arccos(-middle[2])
    normals = normals @ exp_so3(turn * angle).T
    poses = []
    for board, normal in zip(boards, normals, strict=True):
        toward = np.array([0.0, 0.0, -1.0])
        down = unit(toward - normal * (normal @ toward))
        rotation = np.stack([np.cross(down, -normal), down, -normal], axis=1)
        centre = np.array([0.0, 0.0, 1500.0]) + 330.0 * down
        poses.append(Rigid3(rotation, centre - rotation @ board.points().mean(axis=0)))
    return poses


def make_reconstruction(
    boards: tuple[Board, ...] = BOARDS,
    angles_deg: tuple[float, ...] = (90.0, 90.0, 90.0),
    *,
    camera: Camera | None = None,
    cam2_from_cam1: Rigid3 = CAM2_FROM_CAM1,
    keep: tuple[int, ...] = (0, 1, 2),
    normal_tilt_rad: float = 0.0,
    points_noise_mm: float = 0.0,
    rng: np.random.Generator | None = None,
    pose_covariance: np.ndarray | None = None,
    baseline_sigma_mm: float = 0.5,
) -> Reconstruction:
    """An exact reconstruction of the boards `keep`; optionally all normals tilted by one angle, points with noise."""
    seen = camera or Pinhole((1624, 1240), np.array([1356.0, 1356.0, 811.5, 619.5]))
    poses = trihedral_poses(boards, angles_deg)
    kept = tuple(boards[k] for k in keep)
    points = np.concatenate([poses[k].apply(boards[k].points()) for k in keep])
    normals = np.concatenate([np.tile(-poses[k].rotation[:, 2], (boards[k].corner_count, 1)) for k in keep])
    side = unit(np.cross(normals, [0.3, 0.5, 0.8]))
    normals = unit(normals * np.cos(normal_tilt_rad) + side * np.sin(normal_tilt_rad))
    index = np.repeat(np.arange(len(kept)), [b.corner_count for b in kept])
    grid = np.concatenate([b.grid() for b in kept])
    pixels1, valid1 = seen.project(points)
    pixels2, valid2 = seen.project(cam2_from_cam1.apply(points))
    assert valid1.all()
    assert valid2.all()
    n = len(points)
    if rng is not None:
        points = points + rng.normal(size=points.shape) * points_noise_mm
    colours = np.arange(3 * n, dtype=np.int64).reshape(n, 3) % 256
    cloud = OrientedCloud(
        points_mm=points,
        normals=normals,
        colours=colours.astype(np.uint8),
        board_index=index,
        grid=grid,
        sigma_mm=np.linspace(0.1, 0.3, n),
        normal_sigma_rad=np.linspace(0.001, 0.002, n),
        board_ids=tuple(b.board_id for b in kept),
    )
    essential = skew(cam2_from_cam1.translation_mm) @ cam2_from_cam1.rotation
    return Reconstruction(
        pair_id="made",
        pose_type=PoseType.GENERAL,
        affine_method="3SDIR",
        camera1=seen,
        camera2=seen,
        boards=kept,
        matches=Matches.from_cameras(seen, seen, pixels1, pixels2, board_index=index, grid=grid),
        pixels1=pixels1,
        pixels2=pixels2,
        cam2_from_cam1=cam2_from_cam1,
        pose_covariance=pose_covariance,
        E21=essential / np.linalg.norm(essential),
        cloud=cloud,
        baseline_mm=float(np.linalg.norm(cam2_from_cam1.translation_mm)),
        baseline_sigma_mm=baseline_sigma_mm,
        sampson_rms_px=0.05,
    )
