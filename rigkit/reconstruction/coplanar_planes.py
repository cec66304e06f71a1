"""The boards' planes of maximum likelihood where all that is known of a board's points is that they share a plane.

Between the lattice, of which everything is known, and free points, of which nothing is: a plane takes the first image
to the second by a homography, so that a corner leaves two residuals where a free point leaves one. Relative pose and
planes are estimated together. What the squares measure gives the length, as it does for free points.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from rigkit.cameras.uncertain import UncertainCamera
from rigkit.core.arrays import BoolArray, FloatArray, IntArray, Points
from rigkit.core.boards import Board
from rigkit.core.errors import DegenerateError
from rigkit.core.matches import Matches
from rigkit.geometry.rigid3 import Rigid3
from rigkit.geometry.rotation import log_so3
from rigkit.reconstruction.board_planes import (
    MIN_CORNERS_OF_BOARD,
    BoardPlanes,
    inverse_information,
    near_the_rest,
)
from rigkit.reconstruction.coplanar_problem import CoplanarProblem, CoplanarState
from rigkit.reconstruction.moved_cameras import moved_cameras, seen_by_all
from rigkit.reconstruction.noise_level import variance_factor
from rigkit.reconstruction.scale import board_scales_and_gradients, square_sigmas

if TYPE_CHECKING:
    from rigkit.reconstruction.geometry import PairGeometry

OUTLIER_ROUNDS = 3
STEP = 1e-6
"""For central differences, of each parameter's unit: far above rounding, far below where anything bends."""


@dataclass(frozen=True, eq=False, kw_only=True)
class CoplanarPlanes(BoardPlanes):
    """Relative pose and boards' planes of maximum likelihood, the points of a board in one plane.

    A plane's shift is along its normal; corners seen in both views count once.

    Attributes
    ----------
    normals, offsets_mm : (K, 3), (K,), in the order of `board_ids`.
    board_index, grid : (N,), (N, 2), which corners `points_mm` are.
    points_mm, points_covariance : (N, 3), (N, 3, 3) mm, on the planes, the calibrations' share included.
    """

    normals: FloatArray
    offsets_mm: FloatArray
    board_index: IntArray
    grid: IntArray
    points_mm: Points
    points_covariance: FloatArray

    def normal(self, board_id: str) -> FloatArray:
        """Return the unit normal (3,) of a board, facing camera 1."""
        return np.asarray(self.normals[self.board_ids.index(board_id)])

    def offset_mm(self, board_id: str) -> float:
        """Return n . x of the board's points."""
        return float(self.offsets_mm[self.board_ids.index(board_id)])

    def has_points(self, board: Board, grid: FloatArray) -> BoolArray:
        """Return which of the corners `grid` (N, 2) of a board take part."""
        return np.asarray(self._rows(board, grid) >= 0)

    def points(self, board: Board, grid: FloatArray) -> tuple[Points, FloatArray]:
        """Return a board's corners `grid` (N, 2) in camera 1, mm, and their covariances (N, 3, 3).

        Raises DegenerateError for a corner that takes no part.
        """
        rows = self._rows(board, grid)
        if (rows < 0).any():
            raise DegenerateError(f"board '{board.board_id}': {int((rows < 0).sum())} corners lie on no fitted plane")
        return self.points_mm[rows], self.points_covariance[rows]

    def _rows(self, board: Board, grid: FloatArray) -> IntArray:
        """Return which row each corner is, -1 where it is none."""
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
    """Return the boards' planes of maximum likelihood, the points of each board in one plane.

    Parameters, errors : as of `lattice_planes`. The pose type holds as it does in the geometry: freely, exactly, or as
    a level's prior.

    Notes
    -----
    The calibrations' share is found by fitting again with the cameras moved along each principal axis.
    """
    pair = geometry.pair
    moved = moved_cameras(pair.camera1, pair.camera2, known1, known2, one=one_camera)
    cameras = [(pair.camera1, pair.camera2), *moved]
    seen = seen_by_all(cameras, pair.captured.pixels1, pair.captured.pixels2)
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
    fit = _Fit.of(problem, state, boards, pair.pair_id)
    again = [fit.moved(problem.through(*two), boards) for two in moved]
    return _result(fit, again, boards, total)


def _on_boards(matches: Matches, boards: tuple[Board, ...]) -> tuple[Matches, list[Board], int]:
    """Return the matches on boards with enough of them, numbered anew, these boards, and how many matches they have."""
    counts = np.bincount(matches.board_index[matches.board_index >= 0], minlength=len(boards))
    chosen = np.flatnonzero(counts >= MIN_CORNERS_OF_BOARD)
    kept = matches.select(np.isin(matches.board_index, chosen))
    numbered = replace(kept, board_index=np.searchsorted(chosen, kept.board_index))
    return numbered, [boards[k] for k in chosen], len(kept)


def _without_outliers(problem: CoplanarProblem, state: CoplanarState) -> tuple[CoplanarProblem, CoplanarState]:
    """Return the problem without gross outliers, and its minimum."""
    for _ in range(OUTLIER_ROUNDS):
        state = problem.minimum(state)
        near = near_the_rest(np.linalg.norm(problem.corners(state)[0], axis=1))
        enough = np.bincount(problem.matches.board_index[near], minlength=len(state.planes)) >= MIN_CORNERS_OF_BOARD
        if near.all() or not enough.all():
            break
        problem = problem.select(near)
    return problem, problem.minimum(state)


@dataclass(frozen=True, eq=False, kw_only=True)
class _Fit:
    """A minimum, how certain it is, and its scale.

    Every board's squares give a scale, from points that weigh as well as they are known. How certain it is depends on
    how well the board's plane is known, and the planes are known together: the scale is that of generalised least
    squares.

    Attributes
    ----------
    problem, state, metric : the minimum, and it in mm.
    covariance : (F, F) of the free parameters.
    factor : observed over stated variance of the corners.
    motions : (F, N, 3) derivatives of the points by the free parameters.
    noise, weighing : (N, 3, 3) covariances of the points for this state, and in all.
    scale_weights : (K,) of the boards' scales.
    scale_by_state, scale_sigma : derivative of the scale (F,), and its standard deviation for this state, in mm.
    """

    problem: CoplanarProblem
    state: CoplanarState
    metric: _Metric
    covariance: FloatArray
    factor: float
    motions: FloatArray
    noise: FloatArray
    weighing: FloatArray
    scale_weights: FloatArray
    scale_by_state: FloatArray
    scale_sigma: float

    @classmethod
    def of(cls, problem: CoplanarProblem, state: CoplanarState, boards: list[Board], pair_id: str) -> _Fit:
        here = problem.linearise(state)
        count = 2 * len(problem.matches)
        factor = variance_factor(float(here.residual[:count] @ here.residual[:count]), count - here.jacobian.shape[1])
        # A level's prior is no noise of the corners: its variance stays what a person said.
        variance = np.where(np.arange(len(here.residual)) < count, factor, 1.0)
        covariance = inverse_information((here.jacobian.T / variance) @ here.jacobian, pair_id)
        points, noise = problem.points(state)
        noise = factor * noise
        motions = problem.motions(state, STEP)
        weighing = noise + np.einsum("fni,fg,gnj->nij", motions, covariance, motions)
        scales, by_points = _board_scales(problem, points, weighing, boards)
        told = np.isfinite(scales)
        own = np.einsum("kni,nij,knj->k", by_points, noise, by_points) + (scales * square_sigmas(boards)) ** 2
        by_state = np.einsum("kni,fni->kf", by_points[told], motions)
        solved = np.linalg.solve(np.diag(own[told]) + by_state @ covariance @ by_state.T, np.ones(int(told.sum())))
        weights = np.zeros(len(boards))
        weights[told] = solved / solved.sum()
        return cls(
            problem=problem,
            state=state,
            metric=_Metric.of(problem, state, float(weights[told] @ scales[told])),
            covariance=covariance,
            factor=factor,
            motions=motions,
            noise=noise,
            weighing=weighing,
            scale_weights=weights,
            scale_by_state=weights[told] @ by_state,
            scale_sigma=float(np.sqrt(weights[told] ** 2 @ own[told])),
        )

    def moved(self, problem: CoplanarProblem, boards: list[Board]) -> _Metric:
        """Return the minimum for the same corners through other cameras, everything weighed as it is here."""
        state = problem.minimum(self.state)
        scales, _ = _board_scales(problem, problem.points(state)[0], self.weighing, boards)
        return _Metric.of(problem, state, float(self.scale_weights @ np.nan_to_num(scales)))


def _board_scales(
    problem: CoplanarProblem, points: Points, weighing: FloatArray, boards: list[Board]
) -> tuple[FloatArray, FloatArray]:
    """Return mm to the unit of the points (N, 3) by every board (K,), NaN where it tells none, and the gradients."""
    index, grid = problem.matches.board_index, problem.matches.grid
    scales, _, by_points = board_scales_and_gradients(points, index, grid, boards, weighing)
    return scales, by_points


@dataclass(frozen=True, eq=False)
class _Metric:
    """A state in mm: mm to its unit, cam2_from_cam1, planes and points in camera 1."""

    scale: float
    pose: Rigid3
    normals: FloatArray
    offsets_mm: FloatArray
    points_mm: Points

    @classmethod
    def of(cls, problem: CoplanarProblem, state: CoplanarState, scale: float) -> _Metric:
        pose, normals, offsets = problem.in_camera(state)
        points_mm = scale * problem.turned_back(problem.points(state)[0])
        return cls(scale, Rigid3(pose.rotation, scale * pose.translation_mm), normals, scale * offsets, points_mm)

    def difference(self, other: _Metric) -> FloatArray:
        """Return the parameters (6 + 6 K,) of `other` less those here."""
        turn = log_so3(other.pose.rotation @ self.pose.rotation.T)
        out = [turn, other.pose.translation_mm - self.pose.translation_mm]
        for n, m, o, p in zip(self.normals, other.normals, self.offsets_mm, other.offsets_mm, strict=True):
            out += [np.cross(n, m), (p - o) * n]
        return np.concatenate(out)


def _result(fit: _Fit, again: list[_Metric], boards: list[Board], total: int) -> CoplanarPlanes:
    """Return the planes of a fit, and the same with the calibrations moved, as a result in mm."""
    problem, found = fit.problem, fit.metric
    lengths, by_scale = problem.lengths(fit.state, found.scale)
    by_state = problem.parameter_changes(fit.state) * lengths[:, None] + np.outer(by_scale, fit.scale_by_state)
    points = found.points_mm
    by_point = found.scale * problem.turned_back(fit.motions)
    by_point += fit.scale_by_state[:, None, None] * points / found.scale
    moved = np.array([one.points_mm - points for one in again]).reshape(-1, *points.shape)
    own = found.scale**2 * problem.turned_back(np.swapaxes(problem.turned_back(fit.noise), 1, 2))
    own += (fit.scale_sigma / found.scale) ** 2 * points[:, :, None] * points[:, None, :]
    shared = np.einsum("fni,fg,gnj->nij", by_point, fit.covariance, by_point)
    residuals = problem.corners(fit.state)[0]
    return CoplanarPlanes(
        board_ids=tuple(board.board_id for board in boards),
        cam2_from_cam1=found.pose,
        covariance=by_state @ fit.covariance @ by_state.T + fit.scale_sigma**2 * np.outer(by_scale, by_scale),
        calibration_moves=np.array([found.difference(one) for one in again]).reshape(-1, len(by_scale)),
        variance_factor=fit.factor,
        rms_sigmas=float(np.sqrt(np.mean(residuals**2))),
        count=len(problem.matches),
        gross=total - len(problem.matches),
        normals=found.normals,
        offsets_mm=found.offsets_mm,
        board_index=problem.matches.board_index,
        grid=problem.matches.grid,
        points_mm=points,
        points_covariance=own + shared + np.einsum("ani,anj->nij", moved, moved),
    )
