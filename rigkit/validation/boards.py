"""Fit the plane and the lattice of a reconstructed board."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rigkit.core.arrays import FloatArray, IntArray, Mat3, Normals, Points
from rigkit.core.boards import Board
from rigkit.core.errors import DegenerateError
from rigkit.core.truth import Feature
from rigkit.validation.planes import NormalErrors, Plane, fit_moved, fit_plane, normal_errors


@dataclass(frozen=True, eq=False, slots=True)
class BoardGrid:
    """The lattice x = origin + across * step_x + down * step_y, fitted to the corners; (across, down) in squares.

    Attributes
    ----------
    steps_mm : (3, 3), rows: origin, a square along the columns, a square along the rows.
    scatter_mm2 : (3, 3) covariance of one corner about the lattice.
    cofactor : (3, 3) inverse normal matrix of (1, across, down).
    """

    steps_mm: Mat3
    scatter_mm2: Mat3
    cofactor: Mat3

    def at(self, place: FloatArray) -> tuple[FloatArray, Mat3]:
        """Return the point (3,) at a place (2,) in squares, mm, and its covariance (3, 3)."""
        row = np.array([1.0, *np.asarray(place, dtype=np.float64)])
        return row @ self.steps_mm, self.scatter_mm2 * float(row @ self.cofactor @ row)


@dataclass(frozen=True, eq=False, slots=True)
class BoardPlace:
    """Plane and lattice of a board, for one or several (...) positions of its points.

    Attributes
    ----------
    normal, offset_mm : (..., 3) and (...), of its plane.
    steps_mm : (..., 3, 3), of its lattice.
    """

    normal: Normals
    offset_mm: FloatArray
    steps_mm: Mat3

    def at(self, place: FloatArray) -> Points:
        """Return the points (..., 3) at a place (2,) in squares, mm."""
        return np.asarray(np.array([1.0, *place]) @ self.steps_mm)

    def distances(self, points: Points) -> FloatArray:
        """Return the signed distances (...) of points (..., 3) from the plane, mm."""
        return np.asarray(np.sum(points * self.normal, axis=-1) - self.offset_mm)


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class BoardResult:
    """The reconstruction of one board.

    Attributes
    ----------
    board : the board.
    plane, lattice : fitted to its points.
    normal_errors : of the estimated normals against the plane's.
    square_x_ratio, square_y_ratio : reconstructed over declared square size.
    skew_deg : deviation of the reconstructed columns and rows from perpendicular.
    right_handed : whether columns x rows points into the board, as in the board frame.
    """

    board: Board
    plane: Plane
    lattice: BoardGrid
    normal_errors: NormalErrors
    square_x_ratio: float
    square_y_ratio: float
    skew_deg: float
    right_handed: bool

    @property
    def size_ratio(self) -> float:
        """Reconstructed over declared size of a square: geometric mean of both sides."""
        return float(np.sqrt(self.square_x_ratio * self.square_y_ratio))

    @property
    def placed(self) -> BoardPlace:
        """Plane and lattice without their uncertainty."""
        return BoardPlace(self.plane.normal, np.asarray(self.plane.offset_mm), self.lattice.steps_mm)

    def feature(self, feature: Feature) -> tuple[FloatArray, Mat3]:
        """Return the position (3,) of a corner or the centre, mm, and its covariance (3, 3) from the scatter."""
        return self.lattice.at(self.place(feature))

    def place(self, feature: Feature) -> FloatArray:
        """Return the place (2,) of a corner or the centre on the board, in squares from the first corner."""
        if feature.grid is not None:
            return np.asarray(places_on(self.board, np.array([feature.grid]))[0])
        places = places_on(self.board, self.board.grid())
        return np.asarray(0.5 * (places.min(axis=0) + places.max(axis=0)))


def places_on(board: Board, grid: IntArray) -> FloatArray:
    """Return the places (N, 2) of the corners `grid` (N, 2) on a board, in squares from the first corner."""
    return board.pattern.positions(np.asarray(grid, dtype=np.float64))


def fit_lattice(points_mm: Points, places: FloatArray) -> BoardGrid:
    """Fit the lattice to points (N, 3) at `places` (N, 2) on the board, in squares.

    Raises DegenerateError if the corners are in one row or column, or fewer than four.
    """
    design = _design(places)
    if len(places) < 4 or np.linalg.matrix_rank(design) < 3:
        raise DegenerateError(f"board: {len(places)} corners in one line do not fix its frame; more of it must be seen")
    steps, *_ = np.linalg.lstsq(design, points_mm, rcond=None)
    residuals = points_mm - design @ steps
    scatter = np.asarray(residuals.T @ residuals / (len(places) - 3))
    return BoardGrid(np.asarray(steps), scatter, np.asarray(np.linalg.inv(design.T @ design)))


def _design(places: FloatArray) -> FloatArray:
    return np.concatenate([np.ones((len(places), 1)), places], axis=1)


def place_perturbed(points_mm: Points, places: FloatArray, like: Plane) -> BoardPlace:
    """Return plane and lattice for M perturbed copies (M, N, 3) of the points that `like` was fitted to.

    `places` (N, 2) are the points' places on the board, in squares.
    """
    used = points_mm[:, like.used]
    many = np.swapaxes(used, 0, 1).reshape(used.shape[1], -1)
    steps, *_ = np.linalg.lstsq(_design(places[like.used]), many, rcond=None)
    return BoardPlace(*fit_moved(points_mm, like), np.swapaxes(steps.reshape(3, len(used), 3), 0, 1))


def measure_board(
    board: Board,
    points_mm: Points,
    normals: Normals,
    grid: IntArray,
    covariance_mm2: FloatArray | None = None,
    common_mm: FloatArray | None = None,
) -> BoardResult:
    """Return plane, lattice and normal errors of one board's points (N, 3), normals (N, 3) and grid (N, 2).

    See `fit_plane` for `covariance_mm2` and `common_mm`. The lattice is fitted to the same points as the plane; normal
    errors are of all normals.

    Raises DegenerateError if too few corners are left; the message names the board.
    """
    try:
        plane = fit_plane(points_mm, covariance_mm2, common_mm)
        lattice = fit_lattice(points_mm[plane.used], places_on(board, grid[plane.used]))
    except DegenerateError as error:
        raise DegenerateError(f"board '{board.board_id}': {error}") from error
    _, along, down = lattice.steps_mm
    x, y = float(np.linalg.norm(along)), float(np.linalg.norm(down))
    return BoardResult(
        board=board,
        plane=plane,
        lattice=lattice,
        normal_errors=normal_errors(normals, plane.normal),
        square_x_ratio=x / board.square_x_mm,
        square_y_ratio=y / board.square_y_mm,
        skew_deg=float(np.rad2deg(np.arcsin(np.clip(abs(along @ down) / (x * y), 0.0, 1.0)))),
        right_handed=bool(np.cross(along, down) @ plane.normal < 0.0),
    )
