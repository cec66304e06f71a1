"""Views as padded arrays (views, corners), so that every step of the calibration is one array operation."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from rigkit.calibration.views.repeats import cluster_numbers, folds_of
from rigkit.core.arrays import BoolArray, FloatArray, IntArray, Points, median_of
from rigkit.core.boards import Board
from rigkit.core.detections import BoardView
from rigkit.core.errors import InputError

SIGMA_RANGE = 8.0
"""Corner sigmas are limited to this factor from their median: a predicted 0.001 px must not dominate the solution."""


class Workspace:
    """Memory for the derivatives of a block of views, reused by all linearisations: allocating it would take longer
    than the arithmetic."""

    def __init__(self) -> None:
        self._memory: FloatArray = np.empty(0)

    def derivatives(self, parameters: int, corners: int) -> tuple[FloatArray, FloatArray]:
        """Return memory for the derivatives of N corners by their points (2, 3, N), with arbitrary values, and by P
        parameters (2, P, N), zeros: valid until the next call."""
        size = 2 * (3 + parameters) * corners
        if self._memory.size < size:
            self._memory = np.empty(size)
        d_pixels_d_point, d_pixels_d_parameters = self._memory[: 6 * corners], self._memory[6 * corners : size]
        d_pixels_d_parameters.fill(0.0)
        return d_pixels_d_point.reshape(2, 3, corners), d_pixels_d_parameters.reshape(2, parameters, corners)


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class Observations:
    """Corners of V views, padded to C corners.

    Attributes
    ----------
    views : the V views.
    pixels : (V, C, 2), zero where padded.
    corner : (V, C) int, row of the corner in the table of all boards' points; zero where padded.
    sigma_px : (V, C) predicted standard deviation of each corner, one where padded.
    weight : (V, C) median sigma over sigma of the corner, zero where padded: weighted residuals stay in px.
    present : (V, C) bool, False where padded.
    boards : the boards, in the order of the table.
    first_row : (len(boards) + 1,) first row of each board in the table.
    board : (V,) int, board of each view.
    workspace : of the solver; subsets share it.
    known_clusters, known_folds : caches of `clusters` and `folds`, shared by observations of the same views.
    """

    views: tuple[BoardView, ...]
    pixels: FloatArray
    corner: IntArray
    sigma_px: FloatArray
    weight: FloatArray
    present: BoolArray
    boards: tuple[Board, ...]
    first_row: IntArray
    board: IntArray
    workspace: Workspace = field(default_factory=Workspace, repr=False)
    known_clusters: list[IntArray] = field(default_factory=list, repr=False)
    known_folds: dict[int, IntArray] = field(default_factory=dict, repr=False)

    @classmethod
    def from_views(cls, views: Sequence[BoardView]) -> Observations:
        """Return the padded views. Raises InputError where a corner lies outside its board or occurs twice, or boards
        of two sizes have the same name."""
        boards: dict[str, Board] = {}
        for view in views:
            known = boards.setdefault(view.board.board_id, view.board)
            if _measures(known) != _measures(view.board):
                raise InputError(f"image '{view.image}': board '{known.board_id}' has another size in another view")
        index = {name: i for i, name in enumerate(boards)}
        counts = [b.corner_count for b in boards.values()]
        first_row = np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)
        board = np.array([index[view.board.board_id] for view in views], dtype=np.int64)
        length = np.array([len(view.grid) for view in views], dtype=np.int64)
        present = np.arange(length.max(initial=0)) < length[:, None]
        pixels, corner = np.zeros((*present.shape, 2)), np.zeros(present.shape, dtype=np.int64)
        sigma = np.ones(present.shape)
        corner += first_row[board][:, None]
        if views:
            flat = np.flatnonzero(present)
            view_of = np.repeat(np.arange(len(views)), length)
            pixels.reshape(-1, 2)[flat] = np.concatenate([view.pixels for view in views])
            own_sigma = np.concatenate([view.sigma_px for view in views])
            sigma.reshape(-1)[flat] = own_sigma
            size = np.array([one.size for one in boards.values()])[board[view_of]]
            grid = np.concatenate([view.grid for view in views])
            _check(views, view_of, grid, size, own_sigma)
            place = grid[:, 1] * size[:, 0] + grid[:, 0]
            _check_once(views, view_of, place, max(counts))
            corner.reshape(-1)[flat] += place
        weight = _weights(sigma, present)
        table = tuple(boards.values())
        return cls(
            views=tuple(views),
            pixels=pixels,
            corner=corner,
            sigma_px=sigma,
            weight=weight,
            present=present,
            boards=table,
            first_row=first_row,
            board=board,
        )

    def table(self) -> Points:
        """Return the flat corners of all boards, (M, 3) mm."""
        return np.concatenate([board.points() for board in self.boards])

    def with_common_error(self, squared_px: FloatArray, kept: BoolArray) -> Observations:
        """Return the observations with weights for sigma^2 + s^2, where s is an error common to all corners (of the
        lens or board model) that explains the residuals.

        `squared_px` (V, C) are squared 2-D residuals, `kept` (V, C) the corners to estimate s from.
        """
        excess = float((0.5 * squared_px - self.sigma_px**2)[kept].mean()) if kept.any() else 0.0
        sigma = np.sqrt(self.sigma_px**2 + max(excess, 0.0))
        return replace(self, weight=_weights(sigma, self.present))

    def subset(self, chosen: IntArray) -> Observations:
        """Return the views with the indices `chosen`, with the same table of boards."""
        return replace(
            self,
            views=tuple(self.views[i] for i in chosen),
            pixels=self.pixels[chosen],
            corner=self.corner[chosen],
            sigma_px=self.sigma_px[chosen],
            weight=self.weight[chosen],
            present=self.present[chosen],
            board=self.board[chosen],
            known_clusters=[],
            known_folds={},
        )

    @property
    def images(self) -> list[str]:
        """Name of the image of each view."""
        return [view.image for view in self.views]

    def clusters(self) -> IntArray:
        """Return the cluster of each view (V,): its image, with near-duplicate images in one cluster."""
        if not self.known_clusters:
            boards, pixels = [view.board.board_id for view in self.views], [view.pixels for view in self.views]
            self.known_clusters.append(cluster_numbers(self.images, boards, pixels))
        return self.known_clusters[0]

    def folds(self, count: int) -> IntArray:
        """Return the fold of each view (V,), of `count` folds; with fewer images each is a fold."""
        if count not in self.known_folds:
            clusters = self.clusters()
            self.known_folds[count] = folds_of([view.pixels for view in self.views], clusters, count)[clusters]
        return self.known_folds[count]


def _check(views: Sequence[BoardView], view_of: IntArray, grid: IntArray, size: IntArray, sigma: FloatArray) -> None:
    outside = ((grid < 0) | (grid >= size)).any(axis=1)
    if outside.any():
        view = views[view_of[outside.argmax()]]
        raise InputError(
            f"image '{view.image}': corners outside board '{view.board.board_id}' ({view.board.columns}x"
            f"{view.board.rows} inner corners); check the board's size"
        )
    if (sigma <= 0.0).any():
        raise InputError(f"image '{views[view_of[(sigma <= 0.0).argmax()]].image}': corner sigmas must be positive")


def _measures(board: Board) -> tuple[int, int, float, float]:
    return (*board.size, board.square_x_mm, board.square_y_mm)


def _check_once(views: Sequence[BoardView], view_of: IntArray, place: IntArray, largest: int) -> None:
    """Raise InputError where a view has a corner twice; `place` (N,) is the index of each corner on its board, of at
    most `largest` corners."""
    count = np.bincount(view_of * largest + place)
    if count.max(initial=0) > 1:
        view = views[int(count.argmax()) // largest]
        raise InputError(f"image '{view.image}': a corner of board '{view.board.board_id}' comes twice")


def _weights(sigma: FloatArray, present: BoolArray) -> FloatArray:
    median = median_of(sigma[present]) if present.any() else 1.0
    sigma = np.minimum(np.maximum(sigma, median / SIGMA_RANGE), median * SIGMA_RANGE)
    return np.where(present, median / sigma, 0.0)
