"""Fit the boards' planes by maximum likelihood, with the points of each board only known to be coplanar.

This assumes less than a known lattice and more than free points. A plane maps the first image to the second by a
homography, so a corner has two residuals where a free point has one. Relative pose and planes are estimated jointly.
The squares give the scale, as for free points.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from rigkit.cameras.base import Camera
from rigkit.cameras.uncertain import UncertainCamera
from rigkit.core.arrays import BoolArray, FloatArray, IntArray, Points
from rigkit.core.boards import Board
from rigkit.core.errors import DegenerateError
from rigkit.core.matches import Matches
from rigkit.geometry.rigid3 import Rigid3
from rigkit.reconstruction.board_planes import (
    MIN_CORNERS_OF_BOARD,
    OUTLIER_ROUNDS,
    BoardPlanes,
    inliers_by_median,
    variance_and_covariance,
)
from rigkit.reconstruction.coplanar_problem import CoplanarProblem, CoplanarState
from rigkit.reconstruction.geometry import PairGeometry
from rigkit.reconstruction.moved_cameras import Known, moved_cameras, moved_pixels, visible_in_all
from rigkit.reconstruction.scale import board_scales_and_gradients, square_sigmas


@dataclass(frozen=True, eq=False, kw_only=True)
class CoplanarPlanes(BoardPlanes):
    """Maximum-likelihood relative pose and planes of boards with coplanar points.

    A plane's translation is along its normal. A corner seen in both views counts once.

    Attributes
    ----------
    normals : (K, 3) in the order of `board_ids`.
    board_index, grid : (N,), (N, 2), identify the corners in `points_mm`.
    points_mm, points_covariance : (N, 3), (N, 3, 3) mm, on the planes, including the calibrations' uncertainty.
    """

    normals: FloatArray
    board_index: IntArray
    grid: IntArray
    points_mm: Points
    points_covariance: FloatArray

    def normal(self, board_id: str) -> FloatArray:
        """Return the unit normal (3,) of a board, facing camera 1."""
        return np.asarray(self.normals[self.board_ids.index(board_id)])

    def has_points(self, board: Board, grid: FloatArray) -> BoolArray:
        """Return a mask (N,) of the corners `grid` (N, 2) of a board that were used."""
        return np.asarray(self._rows(board, grid) >= 0)

    def points(self, board: Board, grid: FloatArray) -> tuple[Points, FloatArray]:
        """Return a board's corners `grid` (N, 2) in camera 1, mm, and their covariances (N, 3, 3).

        Raises DegenerateError for a corner that was not used.
        """
        rows = self._rows(board, grid)
        if (rows < 0).any():
            raise DegenerateError(f"board '{board.board_id}': {int((rows < 0).sum())} corners lie on no fitted plane")
        return self.points_mm[rows], self.points_covariance[rows]

    def _rows(self, board: Board, grid: FloatArray) -> IntArray:
        """Return the row of each corner in `points_mm`, -1 if it has none."""
        if board.board_id not in self.board_ids:
            return np.full(len(grid), -1)
        own = np.flatnonzero(self.board_index == self.board_ids.index(board.board_id))
        place = np.full((board.columns, board.rows), -1)
        place[tuple(self.grid[own].T)] = own
        return np.asarray(place[tuple(np.asarray(grid, dtype=np.int64).T)])


def coplanar_planes(
    geometry: PairGeometry,
    known1: UncertainCamera | None = None,
    known2: UncertainCamera | None = None,
    *,
    one_camera: bool = False,
) -> CoplanarPlanes:
    """Return the maximum-likelihood planes of boards with coplanar points.

    See `lattice_planes` for parameters, errors, and how the calibrations' uncertainty is propagated. The pose type is
    treated as in the geometry: general, exact, or a prior.
    """
    pair = geometry.pair
    moved = moved_cameras(pair.camera1, pair.camera2, known1, known2, one=one_camera)
    cameras = [(pair.camera1, pair.camera2), *moved]
    seen = visible_in_all(cameras, pair.captured.pixels1, pair.captured.pixels2)
    matches, boards, total = _on_boards(pair.captured.select(seen), pair.boards)
    if not boards:
        raise DegenerateError(
            f"pair '{pair.pair_id}': no board has {MIN_CORNERS_OF_BOARD} corners seen in both views for a plane of its "
            "own; take images that show whole boards"
        )
    problem = CoplanarProblem.of(matches, geometry.decision)
    planes = [geometry.pair.identity.cam1_from_board[board.board_id] for board in boards]
    state = problem.start(geometry.refined.cam2_from_cam1, planes, geometry.metric.baseline_mm)
    problem, state = _without_outliers(problem, state)
    return _result(problem, state, boards, total, moved, (known1, known1 if one_camera else known2), pair.pair_id)


def _on_boards(matches: Matches, boards: tuple[Board, ...]) -> tuple[Matches, list[Board], int]:
    """Return the matches on boards with enough of them (renumbered), these boards, and the number of matches."""
    counts = np.bincount(matches.board_index[matches.board_index >= 0], minlength=len(boards))
    chosen = np.flatnonzero(counts >= MIN_CORNERS_OF_BOARD)
    kept = matches.select(np.isin(matches.board_index, chosen))
    numbered = replace(kept, board_index=np.searchsorted(chosen, kept.board_index))
    return numbered, [boards[k] for k in chosen], len(kept)


def _without_outliers(problem: CoplanarProblem, state: CoplanarState) -> tuple[CoplanarProblem, CoplanarState]:
    """Return the problem without outliers, and its minimum."""
    for _ in range(OUTLIER_ROUNDS):
        state = problem.minimum(state)
        near = inliers_by_median(np.linalg.norm(problem.corners(state)[0], axis=1))
        enough = np.bincount(problem.matches.board_index[near], minlength=len(state.planes)) >= MIN_CORNERS_OF_BOARD
        if near.all() or not enough.all():
            break
        problem = problem.select(near)
    return problem, problem.minimum(state)


class _Scale(NamedTuple):
    """Mm per unit of a state, its derivatives by the points (N, 3) and by the free parameters (F,), and its standard
    deviation for this state.

    Every board's squares give a scale. Errors of these scales are correlated through the planes, so that they are
    averaged by generalised least squares.
    """

    value: float
    by_points: FloatArray
    by_state: FloatArray
    sigma: float

    @classmethod
    def of(
        cls,
        matches: Matches,
        boards: list[Board],
        points: Points,
        noise: FloatArray,
        point_jacobians: FloatArray,
        covariance: FloatArray,
    ) -> _Scale:
        """Return the scale from points (N, 3), their covariances for this state (N, 3, 3), their derivatives (F, N, 3)
        by the free parameters, and the covariance (F, F) of these."""
        weighing = noise + np.einsum("fni,fg,gnj->nij", point_jacobians, covariance, point_jacobians)
        found = board_scales_and_gradients(points, matches.board_index, matches.grid, boards, weighing)
        known = np.isfinite(found[0])
        scales, by_points = found[0][known], found[2][known]
        own = np.einsum("kni,nij,knj->k", by_points, noise, by_points) + (scales * square_sigmas(boards)[known]) ** 2
        by_state = np.einsum("kni,fni->kf", by_points, point_jacobians)
        weights = np.linalg.solve(np.diag(own) + by_state @ covariance @ by_state.T, np.ones(len(scales)))
        weights /= weights.sum()
        gradient = np.einsum("k,kni->ni", weights, by_points)
        return cls(float(weights @ scales), gradient, weights @ by_state, float(np.sqrt(weights**2 @ own)))


def _result(
    problem: CoplanarProblem,
    state: CoplanarState,
    boards: list[Board],
    total: int,
    moved: list[tuple[Camera, Camera]],
    known: Known,
    pair_id: str,
) -> CoplanarPlanes:
    """Return the planes at a minimum in mm, with the covariance from the residuals and the moved cameras."""
    here, count = problem.linearise(state), len(problem.matches)
    factor, of_free = variance_and_covariance(here, count, here.jacobian.shape[1], pair_id)
    points, noise = problem.points(state)
    noise, point_jacobians = factor * noise, problem.point_jacobians(state)
    scale = _Scale.of(problem.matches, boards, points, noise, point_jacobians, of_free)
    lengths, by_scale = problem.lengths(state, scale.value)
    by_state = problem.parameter_jacobian(state) * lengths[:, None] + np.outer(by_scale, scale.by_state)
    points_mm = scale.value * problem.from_level1(points)
    by_point = scale.value * problem.from_level1(point_jacobians) + np.multiply.outer(
        scale.by_state, points_mm / scale.value
    )
    moves, point_moves = [np.zeros((0, len(by_scale)))], [np.zeros((0, *points.shape))]
    residuals = here.residual[: 2 * count]
    pose, normals, _ = problem.in_camera(state)
    cam2_from_cam1 = Rigid3(pose.rotation, scale.value * pose.translation_mm)
    pixels, in_cameras = (
        (problem.matches.pixels1, problem.matches.pixels2),
        (points_mm, cam2_from_cam1.apply(points_mm)),
    )
    for cameras in moved:
        there = problem.with_cameras(cameras, moved_pixels(pixels, in_cameras, known, cameras))
        change = there.corners(state)[0].ravel() - residuals
        step = -of_free @ here.jacobian[: 2 * count].T @ change / factor
        # At a fixed state only the points move, and with them the scale.
        shift = there.points(state)[0] - points
        lengthening = float(np.sum(scale.by_points * shift))
        moves.append((by_state @ step + lengthening * by_scale)[None])
        shift = scale.value * problem.from_level1(shift) + lengthening * points_mm / scale.value
        point_moves.append((shift + np.einsum("f,fni->ni", step, by_point))[None])
    of_points = np.concatenate(point_moves)
    own = scale.value**2 * problem.from_level1(np.swapaxes(problem.from_level1(noise), 1, 2))
    own += (scale.sigma / scale.value) ** 2 * points_mm[:, :, None] * points_mm[:, None, :]
    shared = np.einsum("fni,fg,gnj->nij", by_point, of_free, by_point)
    return CoplanarPlanes(
        board_ids=tuple(board.board_id for board in boards),
        cam2_from_cam1=cam2_from_cam1,
        covariance=by_state @ of_free @ by_state.T + scale.sigma**2 * np.outer(by_scale, by_scale),
        calibration_moves=np.concatenate(moves),
        variance_factor=factor,
        count=count,
        gross=total - count,
        normals=normals,
        board_index=problem.matches.board_index,
        grid=problem.matches.grid,
        points_mm=points_mm,
        points_covariance=own + shared + np.einsum("ani,anj->nij", of_points, of_points),
    )
