"""Generate batches of random pairs of views of three boards, for the synthetic study.

Everything is batched over trials. Lengths are in mm, in the frame of camera 1.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rigkit.core.arrays import FloatArray, IntArray, Mat3, Normals, Points, keep_arrays, keep_indices
from rigkit.core.boards import Board
from rigkit.core.errors import DegenerateError, InputError
from rigkit.core.posetype import PoseType
from rigkit.geometry.rotation import exp_so3, skew, unit
from rigkit.synthetic.pairs import PLANAR_YAW_DEG

CAMERA_RANGE_MM = (900.0, 1300.0)
"""Distance of the cameras of general pairs from the corner of the room."""
MIN_INCIDENCE = 0.35
"""Smallest |cosine| between a viewing ray and a board's normal."""
ROLL_DEG = 30.0
AIM_JITTER_DEG = 8.0
MARGIN_SQUARES = 0.5
"""White margin around the squares of a board."""
CANDIDATES_A_DRAW = 4000
"""Candidates of each draw of rejection sampling."""
MAX_DRAWS = 200

SPECIAL_PLANES = (
    ((0.0, -20.0, 1200.0), (0.0, 0.0, 1.0)),
    ((0.0, 300.0, 1000.0), (0.0, 1.0, 0.0)),
    ((400.0, 0.0, 1000.0), (1.0, 0.0, 0.0)),
)
"""Centre (mm) and axis of the three planes that a level camera sees: in front, below, to the right."""


@dataclass(frozen=True, eq=False, slots=True)
class PairBatch:
    """T pairs of views of the same N board corners.

    Attributes
    ----------
    points_mm : (T, N, 3) in the frame of camera 1.
    normals : (T, B, 3) unit normal of each board, facing camera 1.
    rotation21, translation21_mm : (T, 3, 3), (T, 3): x_in_2 = R x_in_1 + t.
    board_index : (N,) int.
    board : the same for all B planes; corners are sorted board by board, row by row.
    """

    points_mm: Points
    normals: Normals
    rotation21: Mat3
    translation21_mm: FloatArray
    board_index: IntArray
    board: Board

    def __post_init__(self) -> None:
        t, n = np.asarray(self.points_mm).shape[:2]
        keep_arrays(self, points_mm=(t, n, 3), normals=(t, None, 3), rotation21=(t, 3, 3), translation21_mm=(t, 3))
        keep_indices(self, board_index=(n,))

    def __len__(self) -> int:
        return len(self.points_mm)

    def points_in_2(self) -> Points:
        """Return the corners in the frame of camera 2, (T, N, 3) mm."""
        return np.asarray(self.points_mm @ np.swapaxes(self.rotation21, 1, 2) + self.translation21_mm[:, None, :])

    def essential(self) -> Mat3:
        """Return the essential matrices, (T, 3, 3), of unit Frobenius norm."""
        e = skew(self.translation21_mm) @ self.rotation21
        return np.asarray(e / np.linalg.norm(e, axis=(1, 2), keepdims=True))


def general_pairs(
    board: Board, trials: int, rng: np.random.Generator, *, parallax_deg: tuple[float, float] = (40.0, 70.0)
) -> PairBatch:
    """Return pairs of independent views of three boards in the corner of a room.

    Both cameras are 0.9 to 1.3 m from the corner, look at it within 8 degrees, roll by up to 30 degrees, and see every
    board corner at no more than 69 degrees from its normal.

    Raises DegenerateError if too few such pairs were found.

    Parameters
    ----------
    parallax_deg : range of the angle between the two cameras at the corner.
    """
    corners, facing = _corner_boards(board)
    n = board.corner_count
    kept: list[tuple[FloatArray, FloatArray]] = []
    found = 0
    for _ in range(MAX_DRAWS):
        eyes = _octant_eyes(corners, facing, board, rng)
        first, second = eyes[: len(eyes) // 2], eyes[len(eyes) // 2 : 2 * (len(eyes) // 2)]
        cosine = np.sum(unit(first) * unit(second), axis=1)
        low, high = np.cos(np.radians(parallax_deg[::-1]))
        fits = (cosine >= low) & (cosine <= high)
        kept.append((first[fits], second[fits]))
        found += int(fits.sum())
        if found >= trials:
            break
    else:
        raise DegenerateError(
            f"general pairs: only {found} of {trials} pairs have a parallax in {parallax_deg} degrees"
        )
    eye1, eye2 = (np.concatenate([pair[k] for pair in kept])[:trials] for k in (0, 1))
    rotation1, rotation2 = _look_at_origin(eye1, rng), _look_at_origin(eye2, rng)
    points = (corners - eye1[:, None, :]) @ np.swapaxes(rotation1, 1, 2)
    rotation21 = rotation2 @ np.swapaxes(rotation1, 1, 2)
    translation = np.einsum("tij,tj->ti", rotation2, eye1 - eye2)
    normals = np.einsum("tij,bj->tbi", rotation1, facing)
    return PairBatch(points, normals, rotation21, translation, np.repeat(np.arange(3), n), board)


def special_pairs(
    board: Board,
    trials: int,
    pose_type: PoseType,
    rng: np.random.Generator,
    *,
    baseline_mm: float = 300.0,
    in_plane_deg: float = 25.0,
) -> PairBatch:
    """Return planar, standard or forward pairs with three planes: in front, below and to the right of camera 1.

    Parameters
    ----------
    in_plane_deg : rotation of the boards in their planes, counter-clockwise in the image. At 0 their edges are parallel
        to the camera's axes, and directions along the baseline have no information.

    Notes
    -----
    Planar: yaw uniform within 10 degrees, direction of motion uniform. Standard and forward pairs are the same in all
    trials: only noise differs.
    """
    n = board.corner_count
    flat = board.points() - board.points().mean(axis=0)
    points, normals = [], []
    for centre, axis in SPECIAL_PLANES:
        axes = _plane_axes(np.array(axis)) @ exp_so3(np.array([0.0, 0.0, -np.radians(in_plane_deg)]))
        points.append(flat @ axes.T + centre)
        normals.append(-np.array(axis))
    yaw, heading = np.zeros(trials), np.full(trials, np.pi)
    if pose_type is PoseType.PLANAR:
        yaw = np.radians(rng.uniform(-PLANAR_YAW_DEG, PLANAR_YAW_DEG, trials))
        heading = rng.uniform(0.0, 2.0 * np.pi, trials)
    elif pose_type is PoseType.STANDARD:
        heading = np.full(trials, -np.pi / 2.0)
    elif pose_type is not PoseType.FORWARD:
        raise InputError(f"special pairs: pose type '{pose_type}' has no special pose; use general_pairs")
    rotation = exp_so3(yaw[:, None] * np.array([0.0, 1.0, 0.0]))
    translation = baseline_mm * np.stack([np.sin(heading), np.zeros(trials), np.cos(heading)], axis=1)
    return PairBatch(
        np.tile(np.concatenate(points), (trials, 1, 1)),
        np.tile(np.array(normals), (trials, 1, 1)),
        rotation,
        translation,
        np.repeat(np.arange(3), n),
        board,
    )


def _corner_boards(board: Board) -> tuple[Points, Normals]:
    """Return the corners of three boards (3 N, 3) whose first corners are nearest to the origin, and their normals.

    Rows, columns and so diagonals lead away from the corner of the room on all three boards, so that estimators that
    use the diagonal treat the planes alike.
    """
    outwards = -np.eye(3)
    flat = board.points()[:, :2] + (1.0 + MARGIN_SQUARES) * np.array([board.square_x_mm, board.square_y_mm])
    corners = [flat @ outwards[[i, j]] for i, j in ((0, 1), (0, 2), (2, 1))]
    return np.concatenate(corners), outwards[[2, 1, 0]]


def _octant_eyes(corners: Points, facing: Normals, board: Board, rng: np.random.Generator) -> Points:
    """Return random camera centres (M, 3) in the room with sufficient incidence at every corner."""
    direction = unit(-np.abs(rng.standard_normal((CANDIDATES_A_DRAW, 3))))
    eyes = direction * rng.uniform(*CAMERA_RANGE_MM, (CANDIDATES_A_DRAW, 1))
    good = np.ones(CANDIDATES_A_DRAW, dtype=bool)
    outer = np.array([0, board.columns - 1, board.corner_count - board.columns, board.corner_count - 1])
    for k, normal in enumerate(facing):
        # |cosine| = height / distance is smallest at the farthest point, one of the four outer corners.
        rays = unit(corners[k * board.corner_count + outer] - eyes[:, None, :])
        good &= (rays @ normal).max(axis=1) < -MIN_INCIDENCE
    return eyes[good]


def _look_at_origin(eyes: Points, rng: np.random.Generator) -> Mat3:
    """Return cam_from_world rotations (T, 3, 3) that look at the origin, with random roll and aim."""
    z = unit(-eyes)
    x = unit(np.cross(np.array([0.0, 1.0, 0.0]), z))
    rotation = np.stack([x, np.cross(z, x), z], axis=1)
    trials = len(eyes)
    jitter = np.radians(rng.uniform(-AIM_JITTER_DEG, AIM_JITTER_DEG, (trials, 2)))
    roll = np.radians(rng.uniform(-ROLL_DEG, ROLL_DEG, trials))
    aim = exp_so3(np.concatenate([jitter, np.zeros((trials, 1))], axis=1))
    return np.asarray(exp_so3(roll[:, None] * np.array([0.0, 0.0, 1.0])) @ aim @ rotation)


def _plane_axes(normal: FloatArray) -> Mat3:
    """Return axes (columns x, y, z = normal) with x and y along the camera's axes."""
    x = np.array([0.0, 0.0, -1.0]) if abs(normal[0]) > 0.5 else np.array([1.0, 0.0, 0.0])
    return np.stack([x, np.cross(normal, x), normal], axis=1)
