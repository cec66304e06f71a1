"""Estimate the relative pose from the pose of every board in each view, without epipolar geometry."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from rigkit.calibration.board_shape import BoardShape
from rigkit.core.arrays import FloatArray, IntArray, Points, Rays
from rigkit.core.boards import Board
from rigkit.core.detections import grid_turned
from rigkit.core.errors import DegenerateError
from rigkit.geometry.board_pose import BoardPose, board_pose, moved_board_poses
from rigkit.geometry.relative_pose import relative_pose, relative_pose_covariance
from rigkit.geometry.rigid3 import Rigid3
from rigkit.geometry.rotation import skew
from rigkit.reconstruction.reconstruct import Reconstruction
from rigkit.validation.planes import angle_jacobian, face_angle

MIN_CORNERS_FOR_PNP = 8

AnglesDeg = dict[tuple[str, str], tuple[float, float]]


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class PnpResult:
    """The result of planar PnP.

    Attributes
    ----------
    cam2_from_cam1 : mean over the boards, weighted by their covariances, mm.
    covariance : (6, 6) of (left rotation perturbation rad, translation mm).
    angles_deg : (a, b) -> (angle between the faces, sigma), mean of both views.
    rms_rad : RMS angle between rays and corners, over all boards and both views.
    variance_factor : observed over predicted variance of the corners; 1 if their sigmas are right. Residuals of a known
        board shape include errors along epipolar lines, which epipolar geometry does not see.
    count : corners used.
    """

    cam2_from_cam1: Rigid3
    covariance: FloatArray
    angles_deg: AnglesDeg
    rms_rad: float
    variance_factor: float
    count: int


def planar_pnp(reconstruction: Reconstruction, shapes: Mapping[str, BoardShape] | None = None) -> PnpResult:
    """Return relative pose and face angles from planar PnP of each board in each view, for any field of view.

    Raises DegenerateError if no board has eight corners.

    Parameters
    ----------
    shapes : measured boards, by id; the others are taken as declared.
    """
    seen = _board_rays([reconstruction], shapes or {})
    if not seen:
        raise DegenerateError(
            f"pair '{reconstruction.pair_id}': no board has {MIN_CORNERS_FOR_PNP} corners for its own pose; "
            "take images that show whole boards"
        )
    poses = {b: (board_pose(s.rays1[0], s.points), board_pose(s.rays2[0], s.points)) for b, s in seen.items()}
    counts = {b: len(s.points) for b, s in seen.items()}
    pose, covariance = _mean_pose([_relative(*both) for both in poses.values()], reconstruction.cam2_from_cam1)
    total = sum(counts.values())
    square = sum(counts[b] * (one.rms_rad**2 + two.rms_rad**2) / 2.0 for b, (one, two) in poses.items()) / total
    # Every pose takes six degrees of freedom from 2N residuals.
    free = 1.0 - 3.0 * len(poses) / total
    factor = square / free / _predicted_square(reconstruction, list(poses))
    return PnpResult(
        cam2_from_cam1=pose,
        covariance=covariance,
        angles_deg=_angles(poses),
        rms_rad=float(np.sqrt(square)),
        variance_factor=factor,
        count=total,
    )


def moved_pnp(
    moved: Sequence[Reconstruction], shapes: Mapping[str, BoardShape] | None = None
) -> tuple[tuple[Rigid3, AnglesDeg], ...]:
    """Return relative pose and face angles of `planar_pnp` for one pair with slightly different cameras.

    Only corners in the field of view of all cameras are used.
    """
    each = {
        name: [
            moved_board_poses(rays, seen.points, board_pose(rays[0], seen.points).cam_from_board)
            for rays in (seen.rays1, seen.rays2)
        ]
        for name, seen in _board_rays(moved, shapes or {}).items()
    }
    out = []
    for m, reconstruction in enumerate(moved):
        poses = {name: (ones[m], twos[m]) for name, (ones, twos) in each.items()}
        pose, _ = _mean_pose([_relative(*both) for both in poses.values()], reconstruction.cam2_from_cam1)
        out.append((pose, _angles(poses)))
    return tuple(out)


@dataclass(frozen=True, eq=False, slots=True)
class _BoardRays:
    """A board's corners (N, 3), mm, and their rays in M cameras of each view, (M, N, 3)."""

    points: Points
    rays1: Rays
    rays2: Rays


def _board_rays(reconstructions: Sequence[Reconstruction], shapes: Mapping[str, BoardShape]) -> dict[str, _BoardRays]:
    """Return, by id, the boards with enough corners that all cameras of these reconstructions of one pair see."""
    first = reconstructions[0]
    rays1, seen1 = zip(*(r.camera1.unproject(r.pixels1) for r in reconstructions), strict=True)
    rays2, seen2 = zip(*(r.camera2.unproject(r.pixels2) for r in reconstructions), strict=True)
    seen = np.logical_and.reduce([*seen1, *seen2])
    out = {}
    for index, board in enumerate(first.boards):
        on = (first.cloud.board_index == index) & seen
        if int(on.sum()) >= MIN_CORNERS_FOR_PNP:
            own1, own2 = np.array(rays1)[:, on], np.array(rays2)[:, on]
            points = _points(board, shapes.get(board.board_id), first.cloud.grid[on], (own1[0], own2[0]))
            out[board.board_id] = _BoardRays(points, own1, own2)
    return out


def _points(board: Board, shape: BoardShape | None, grid: IntArray, rays: tuple[Rays, Rays]) -> Points:
    """Return the corners `grid` (N, 2) of a board, (N, 3) mm, seen along the rays (N, 3) of two views.

    A measured board is not as symmetric as a declared one: of its orientations the one that fits best is returned.
    """
    if shape is None:
        return board.points(grid)
    each = [shape.at(grid_turned(grid, board.size, turns)) for turns in (0, *board.turns)]
    return min(each, key=lambda points: sum(board_pose(seen, points).rms_rad ** 2 for seen in rays))


def _predicted_square(reconstruction: Reconstruction, board_ids: list[str]) -> float:
    """Return the mean square angle between rays and corners, predicted from the corners' sigmas."""
    m = reconstruction.matches
    names = np.array([board.board_id for board in reconstruction.boards])[reconstruction.cloud.board_index]
    on = np.isin(names, board_ids)
    square1 = m.sigma1_px[on] ** 2 * np.sum(m.jacobians1[on] ** 2, axis=(1, 2))
    square2 = m.sigma2_px[on] ** 2 * np.sum(m.jacobians2[on] ** 2, axis=(1, 2))
    return float(np.mean(square1 + square2) / 2.0)


def _relative(one: BoardPose, two: BoardPose) -> tuple[Rigid3, FloatArray]:
    joint = np.zeros((12, 12))
    joint[:6, :6], joint[6:, 6:] = one.covariance, two.covariance
    pose = relative_pose(one.cam_from_board, two.cam_from_board)
    return pose, relative_pose_covariance(one.cam_from_board, two.cam_from_board, joint)


def _mean_pose(found: list[tuple[Rigid3, FloatArray]], near: Rigid3) -> tuple[Rigid3, FloatArray]:
    """Return the mean weighted by information, in the tangent space at `near`."""
    information, pull = np.zeros((6, 6)), np.zeros(6)
    for pose, covariance in found:
        inverse = np.linalg.inv(covariance)
        information += inverse
        pull += inverse @ pose.step_from(near)
    mean: FloatArray = np.asarray(np.linalg.solve(information, pull), dtype=np.float64)
    return near.moved(mean), np.asarray(np.linalg.inv(information), dtype=np.float64)


def _angles(poses: Mapping[str, tuple[BoardPose, BoardPose]]) -> AnglesDeg:
    """Return face angles, the mean of both views weighted by variance."""
    out = {}
    for a, b in combinations(poses, 2):
        weights, values = [], []
        for both in zip(poses[a], poses[b], strict=True):
            one, two = (-pose.cam_from_board.rotation[:, 2] for pose in both)
            variance = 0.0
            for slope, normal, pose in zip(angle_jacobian(one, two), (one, two), both, strict=True):
                by_rotation = slope @ -skew(normal)
                variance += float(by_rotation @ pose.covariance[:3, :3] @ by_rotation)
            values.append(face_angle(one, two))
            weights.append(1.0 / variance)
        mean = float(np.average(values, weights=weights))
        out[a, b] = (float(np.rad2deg(mean)), float(np.rad2deg(1.0 / np.sqrt(sum(weights)))))
    return out
