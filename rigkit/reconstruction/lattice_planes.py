"""The boards' planes from their known lattice: joint maximum likelihood over relative pose and boards' poses.

All corners of both views take part, also those that only one view shows. A free plane is known along the lines of
sight no better than its triangulated points; the lattice fixes its tilt by perspective in each view as well, and the
relative pose ties both views together: the planes are several times more certain, most of all where the baseline is
short or points at the boards.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from rigkit.cameras.base import Camera
from rigkit.cameras.uncertain import UncertainCamera
from rigkit.core.arrays import BoolArray, FloatArray, Points
from rigkit.core.boards import Board
from rigkit.core.errors import DegenerateError
from rigkit.geometry.rigid3 import Rigid3
from rigkit.geometry.rotation import skew
from rigkit.reconstruction.board_planes import MIN_CORNERS_OF_BOARD, BoardPlanes, variance_and_covariance
from rigkit.reconstruction.lattice_problem import (
    LatticeView,
    PlacedLattices,
    fit_without_outliers,
    free_parameters,
    linearised,
    residuals_of,
)
from rigkit.reconstruction.moved_cameras import moved_cameras

if TYPE_CHECKING:
    from rigkit.reconstruction.geometry import PairGeometry


@dataclass(frozen=True, eq=False, kw_only=True)
class LatticePlanes(BoardPlanes):
    """Relative pose and boards' poses of maximum likelihood, with the boards' lattices known.

    The last parameters are the logarithms of the boards' sizes; corners of both views count each.

    Attributes
    ----------
    cam1_from_board : by id, mm.
    """

    cam1_from_board: Mapping[str, Rigid3]

    def normal(self, board_id: str) -> FloatArray:
        """Return the unit normal (3,) of a board, facing camera 1."""
        pose = self.cam1_from_board[board_id]
        normal = pose.rotation[:, 2]
        return np.asarray(-np.sign(normal @ pose.translation_mm) * normal)

    def offset_mm(self, board_id: str) -> float:
        """Return n . x of the board's points."""
        return float(self.normal(board_id) @ self.cam1_from_board[board_id].translation_mm)

    def has_points(self, board: Board, grid: FloatArray) -> BoolArray:
        """Return which of the corners `grid` (N, 2) of a board are known: all, or none of a board that is not."""
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
    """Return the boards' planes of maximum likelihood with their lattices known.

    Parameters
    ----------
    geometry : of the pair; boards need eight corners in each view.
    known1, known2 : the cameras as they are known, or None: the intrinsics are exact.
    one_camera : both images are of one camera, whose errors they share; `known2` is not used then.

    Raises
    ------
    DegenerateError
        No board has enough corners in both views, or they leave the poses open.

    Notes
    -----
    Residuals are pixels over the corners' sigmas; a board whose `square_sigma_mm` is stated has its size as a further
    unknown with that prior, else it is exact. The calibrations' share is linear: moving the cameras along a principal
    axis changes the residuals by dr and the parameters by -(J^T J)^-1 J^T dr.
    """
    pair = geometry.pair
    moved = moved_cameras(pair.camera1, pair.camera2, known1, known2, one=one_camera)
    views, boards = _views(geometry, moved)
    if not boards:
        raise DegenerateError(
            f"pair '{pair.pair_id}': no board has {MIN_CORNERS_OF_BOARD} corners in each view for its own plane; "
            "take images that show whole boards"
        )
    sigma = np.array([(b.square_sigma_mm or 0.0) / np.sqrt(b.square_x_mm * b.square_y_mm) for b in boards])
    identity = pair.identity
    placed = tuple(identity.cam1_from_board[b.board_id] for b in boards)
    state = PlacedLattices(identity.cam2_from_cam1, placed, np.zeros(len(boards)))
    total = sum(len(v.rays) for v in views)
    views, state = fit_without_outliers(views, state, sigma)
    return _result(pair.pair_id, boards, views, state, sigma, moved, total)


def _result(
    pair_id: str,
    boards: list[Board],
    views: list[LatticeView],
    state: PlacedLattices,
    sigma: FloatArray,
    moved: list[tuple[Camera, Camera]],
    total: int,
) -> LatticePlanes:
    """Return the planes at a minimum, with the covariance that the residuals and the moved cameras show."""
    problem, free = linearised(views, state, sigma), free_parameters(sigma)
    count = sum(len(v.rays) for v in views)
    factor, of_free = variance_and_covariance(problem, count, 6 * (len(boards) + 1), pair_id)
    data, jacobian = problem.residual[: 2 * count], problem.jacobian[: 2 * count]
    covariance, moves = np.zeros((len(free), len(free))), np.zeros((len(moved), len(free)))
    covariance[np.ix_(free, free)] = of_free
    moves[:, free] = -_residual_changes(views, state, moved) @ jacobian @ of_free / factor
    return LatticePlanes(
        board_ids=tuple(b.board_id for b in boards),
        cam2_from_cam1=state.pose,
        cam1_from_board={b.board_id: pose for b, pose in zip(boards, state.boards, strict=True)},
        covariance=covariance,
        calibration_moves=moves,
        variance_factor=factor,
        rms_sigmas=float(np.sqrt(np.mean(data**2))),
        count=count,
        gross=total - count,
    )


def _views(geometry: PairGeometry, moved: list[tuple[Camera, Camera]]) -> tuple[list[LatticeView], list[Board]]:
    """Return the corners of every board that has enough of them in both views, and these boards.

    Corners at the rim of the field that one of the moved cameras does not see take no part.
    """
    pair = geometry.pair
    views: list[LatticeView] = []
    boards: list[Board] = []
    found = [{d.board_id: d for d in one} for one in (pair.identity.detections1, pair.identity.detections2)]
    for board in pair.boards:
        both = []
        for second in (False, True):
            corners, cameras = (
                found[second][board.board_id],
                [m[second] for m in ((pair.camera1, pair.camera2), *moved)],
            )
            seen = np.logical_and.reduce([camera.unproject(corners.pixels)[1] for camera in cameras])
            # What the matched corners show of their noise holds as well for those that one view alone has.
            sigma_px, points = geometry.scatter * corners.sigma_px[seen], board.points(corners.grid[seen])
            both.append(LatticeView.of(cameras[0], len(boards), second, corners.pixels[seen], sigma_px, points))
        if all(len(view.rays) >= MIN_CORNERS_OF_BOARD for view in both):
            views += both
            boards.append(board)
    return views, boards


def _residual_changes(
    views: list[LatticeView], state: PlacedLattices, moved: list[tuple[Camera, Camera]]
) -> FloatArray:
    """Return the change (A, R) of the residuals for each of the moved cameras."""
    base = np.concatenate([residuals_of(view, state)[0].ravel() for view in views])
    rows = [[residuals_of(view.by(cameras[view.second]), state)[0].ravel() for view in views] for cameras in moved]
    return np.array([np.concatenate(row) - base for row in rows]).reshape(len(moved), len(base))
