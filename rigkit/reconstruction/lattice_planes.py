"""Fit the boards' planes with known lattices: joint maximum likelihood over relative pose and board poses.

All corners of both views are used, also those that only one view shows. A plane through triangulated points is no more
certain along the line of sight than these. A known lattice also fixes the tilt by perspective in each view. The planes
are several times more certain, above all if the baseline is short or points towards the boards.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import TypeAlias

import numpy as np

from rigkit.cameras.base import Camera
from rigkit.cameras.uncertain import UncertainCamera
from rigkit.core.arrays import BoolArray, FloatArray, IntArray, Pixels, Points
from rigkit.core.boards import Board
from rigkit.core.errors import DegenerateError
from rigkit.geometry.board_pose import facing_normal
from rigkit.geometry.rigid3 import Rigid3
from rigkit.geometry.rotation import skew
from rigkit.identification.joint_pose import BoardCorners, joint_residuals, moved_poses
from rigkit.optim.levenberg_marquardt import DenseProblem
from rigkit.reconstruction.board_planes import (
    MIN_CORNERS_OF_BOARD,
    OUTLIER_ROUNDS,
    BoardPlanes,
    inliers_by_median,
    maximum_likelihood,
    variance_and_covariance,
)
from rigkit.reconstruction.geometry import PairGeometry
from rigkit.reconstruction.moved_cameras import Known, moved_cameras, moved_pixels

PlacedLattices: TypeAlias = tuple[FloatArray, FloatArray, FloatArray]
"""cam2_from_cam1 (4, 4), cam1_from_board (K, 4, 4), and log (K,) of the boards' true over declared sizes."""


@dataclass(frozen=True, eq=False, kw_only=True)
class LatticePlanes(BoardPlanes):
    """Maximum-likelihood relative pose and board poses with known lattices.

    The last parameters are the logarithms of the boards' relative sizes. A corner seen in both views counts twice.

    Attributes
    ----------
    cam1_from_board : by board id, mm.
    """

    cam1_from_board: Mapping[str, Rigid3]

    def normal(self, board_id: str) -> FloatArray:
        """Return the unit normal (3,) of a board, facing camera 1."""
        return facing_normal(self.cam1_from_board[board_id])

    def has_points(self, board: Board, grid: FloatArray) -> BoolArray:
        """Return a mask (N,) of the corners `grid` (N, 2): all of a fitted board, none of another."""
        return np.full(len(grid), board.board_id in self.board_ids)

    def points(self, board: Board, grid: FloatArray) -> tuple[Points, FloatArray]:
        """Return the lattice points at `grid` (N, 2) in camera 1, mm, and their covariances (N, 3, 3)."""
        pose = self.cam1_from_board[board.board_id]
        turned = board.points(np.asarray(grid, dtype=np.int64)) @ pose.rotation.T
        by = np.zeros((len(turned), 3, len(self.covariance)))
        start = self.rotation_of(board.board_id).start
        by[:, :, start : start + 3], by[:, :, start + 3 : start + 6] = -skew(turned), np.eye(3)
        by[:, :, 6 * (len(self.board_ids) + 1) + self.board_ids.index(board.board_id)] = turned
        return turned + pose.translation_mm, by @ self.full_covariance @ np.swapaxes(by, 1, 2)


def lattice_planes(
    geometry: PairGeometry,
    known1: UncertainCamera | None = None,
    known2: UncertainCamera | None = None,
    *,
    one_camera: bool = False,
) -> LatticePlanes:
    """Return the maximum-likelihood planes of the boards with known lattices.

    Raises DegenerateError if no board has enough corners in both views, or they do not determine the poses.

    Parameters
    ----------
    geometry : of the pair; a board needs eight corners in each view.
    known1, known2 : the cameras with their covariance, or None for exact intrinsics.
    one_camera : both images are of one camera and share its errors; `known2` is not used.

    Notes
    -----
    Residuals are whitened pixels. If a board's `square_sigma_mm` is stated, its size is a parameter with that prior,
    else it is exact. The calibrations' uncertainty is propagated linearly: moving the cameras along a principal axis
    changes the residuals by dr and the parameters by -(J^T J)^-1 J^T dr.
    """
    pair = geometry.pair
    moved = moved_cameras(pair.camera1, pair.camera2, known1, known2, one=one_camera)
    problem, boards = _problem(geometry, moved)
    placed = np.array([pair.identity.cam1_from_board[b.board_id].matrix() for b in boards])
    state = pair.identity.cam2_from_cam1.matrix(), placed, np.zeros(len(boards))
    total = problem.count
    problem, state = problem.without_outliers(state)
    here, free = problem.linearise(state), problem.free
    factor, of_free = variance_and_covariance(here, problem.count, 6 * (len(boards) + 1), pair.pair_id)
    data = here.residual[: 2 * problem.count]
    covariance, moves = np.zeros((len(free), len(free))), np.zeros((len(moved), len(free)))
    covariance[np.ix_(free, free)] = of_free
    known = known1, known1 if one_camera else known2
    for k, cameras in enumerate(moved):
        change = problem.with_cameras(cameras, problem.moved_pixels(state, known, cameras)).residuals(state) - data
        moves[k, free] = -of_free @ here.jacobian[: len(data)].T @ change / factor
    poses = [Rigid3.from_matrix(matrix) for matrix in (state[0], *state[1])]
    return LatticePlanes(
        board_ids=tuple(b.board_id for b in boards),
        cam2_from_cam1=poses[0],
        cam1_from_board={b.board_id: pose for b, pose in zip(boards, poses[1:], strict=True)},
        covariance=covariance,
        calibration_moves=moves,
        variance_factor=factor,
        count=problem.count,
        gross=total - problem.count,
    )


def _problem(geometry: PairGeometry, moved: list[tuple[Camera, Camera]]) -> tuple[LatticeProblem, list[Board]]:
    """Return the corners of every board with enough of them in both views, and these boards.

    Corners outside the field of view of any moved camera are left out. Raises DegenerateError if no board is left.
    """
    pair = geometry.pair
    found = [{d.board_id: d for d in one} for one in (pair.identity.detections1, pair.identity.detections2)]
    cameras = [(pair.camera1, pair.camera2), *moved]
    boards: list[Board] = []
    parts: list[list[tuple[Pixels, FloatArray, Points, IntArray]]] = [[], []]
    for board in pair.boards:
        both = []
        for second in (0, 1):
            corners = found[second][board.board_id]
            seen = np.logical_and.reduce([two[second].unproject(corners.pixels)[1] for two in cameras])
            # The noise factor of the matched corners also applies to those seen in one view only.
            sigma_px, number = geometry.scatter * corners.sigma_px[seen], np.full(int(seen.sum()), len(boards))
            both.append((corners.pixels[seen], sigma_px, board.points(corners.grid[seen]), number))
        if min(len(number) for *_, number in both) >= MIN_CORNERS_OF_BOARD:
            boards.append(board)
            for part, view in zip(parts, both, strict=True):
                part.append(view)
    if not boards:
        raise DegenerateError(
            f"pair '{pair.pair_id}': no board has {MIN_CORNERS_OF_BOARD} corners in each view for its own plane; "
            "take images that show whole boards"
        )
    size_sigma = np.array([(b.square_sigma_mm or 0.0) / np.sqrt(b.square_x_mm * b.square_y_mm) for b in boards])
    views = [[np.concatenate(column) for column in zip(*part, strict=True)] for part in parts]
    one, two = (observed_corners(camera, *view) for camera, view in zip(cameras[0], views, strict=True))
    return LatticeProblem((views[0][0], views[1][0]), (one, two), size_sigma), boards


@dataclass(frozen=True, eq=False, slots=True)
class LatticeProblem:
    """Corners of K boards in two images.

    Attributes
    ----------
    pixels, images : the corners in each image.
    size_sigma : (K,) standard deviation of the logarithm of a board's size; 0: the size is exact.
    """

    pixels: tuple[Pixels, Pixels]
    images: tuple[BoardCorners, BoardCorners]
    size_sigma: FloatArray

    @property
    def count(self) -> int:
        """How many corners there are."""
        return sum(len(pixels) for pixels in self.pixels)

    @property
    def free(self) -> BoolArray:
        """Mask of the free parameters; a board's size is free only if its sigma is stated."""
        return np.concatenate([np.ones(6 * (len(self.size_sigma) + 1), dtype=bool), self.size_sigma > 0.0])

    def moved_pixels(self, state: PlacedLattices, known: Known, moved: tuple[Camera, Camera]) -> tuple[Pixels, Pixels]:
        """Return the corners as `moved_pixels` corrects them for moved cameras, with the boards at `state`."""
        motion, boards, log_sizes = state
        points = []
        for c, second in zip(self.images, (False, True), strict=True):
            p = np.exp(log_sizes)[c.board, None] * c.points
            p = np.einsum("nij,nj->ni", boards[c.board, :3, :3], p) + boards[c.board, :3, 3]
            points.append(p @ motion[:3, :3].T + motion[:3, 3] if second else p)
        return moved_pixels(self.pixels, (points[0], points[1]), known, moved)

    def with_cameras(self, cameras: tuple[Camera, Camera], pixels: tuple[Pixels, Pixels]) -> LatticeProblem:
        """Return the same corners, at new pixels, for other cameras."""
        first, second = (
            observed_corners(camera, at, c.sigma_px, c.points, c.board)
            for camera, at, c in zip(cameras, pixels, self.images, strict=True)
        )
        return replace(self, images=(first, second))

    def residuals(self, state: PlacedLattices) -> FloatArray:
        """Return the whitened residuals (2 N,) of the corners."""
        return joint_residuals(self.images, *state)[0]

    def linearise(self, state: PlacedLattices) -> DenseProblem:
        """Return all whitened residuals, those of the size priors last, and their Jacobian by the free parameters."""
        residual, jacobian = joint_residuals(self.images, *state)
        stated = self.size_sigma > 0.0
        sigma = self.size_sigma[stated]
        prior = np.zeros((len(sigma), jacobian.shape[1]))
        prior[:, -len(stated) :] = np.eye(len(stated))[stated] / sigma[:, None]
        rows = np.concatenate([jacobian, prior])
        return DenseProblem(np.concatenate([residual, state[2][stated] / sigma]), rows[:, self.free])

    def minimum(self, state: PlacedLattices) -> PlacedLattices:
        """Return the state of maximum likelihood near `state`."""
        return maximum_likelihood(state, self.linearise, _moved, self.free)

    def without_outliers(self, state: PlacedLattices) -> tuple[LatticeProblem, PlacedLattices]:
        """Return the problem without outliers, and its minimum."""
        problem = self
        for _ in range(OUTLIER_ROUNDS):
            state = problem.minimum(state)
            near = inliers_by_median(np.linalg.norm(problem.residuals(state).reshape(-1, 2), axis=1))
            each = np.split(near, [len(problem.pixels[0])])
            seen = zip(problem.images, each, strict=True)
            left = [np.bincount(c.board[kept], minlength=len(state[1])) for c, kept in seen]
            if near.all() or np.min(left) < MIN_CORNERS_OF_BOARD:
                return problem, state
            problem = problem._select(each)
        return problem, problem.minimum(state)

    def _select(self, each: list[BoolArray]) -> LatticeProblem:
        pixels, images = [], []
        for at, c, kept in zip(self.pixels, self.images, each, strict=True):
            pixels.append(at[kept])
            images.append(BoardCorners(c.rays[kept], c.bases[kept], c.points[kept], c.board[kept], c.sigma_px[kept]))
        return replace(self, pixels=(pixels[0], pixels[1]), images=(images[0], images[1]))


def observed_corners(
    camera: Camera, pixels: Pixels, sigma_px: FloatArray, points: Points, board: IntArray
) -> BoardCorners:
    """Return the corners with their rays in a camera, and the bases that whiten their residuals."""
    bases = np.linalg.pinv(camera.ray_jacobian(pixels)) / sigma_px[:, None, None]
    return BoardCorners(camera.unproject(pixels)[0], np.asarray(bases), points, board, sigma_px)


def _moved(state: PlacedLattices, step: FloatArray) -> PlacedLattices:
    motion, boards, log_sizes = state
    by_pose = step[: -len(boards)].reshape(-1, 6)
    return moved_poses(motion, by_pose[0]), moved_poses(boards, by_pose[1:]), log_sizes + step[-len(boards) :]
