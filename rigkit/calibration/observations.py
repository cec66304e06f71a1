"""Views as padded arrays: (views, corners), so that every step of the calibration is one array operation."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from rigkit.arrays import BoolArray, FloatArray, IntArray, Points
from rigkit.boards import Board
from rigkit.detections import BoardView
from rigkit.errors import InputError

__all__ = ["Observations"]

SIGMA_RANGE = 8.0
"""Corner sigmas are believed within this factor of their median: a predicted 0.001 px must not rule the solution."""


@dataclass(frozen=True, eq=False, slots=True)
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

    @classmethod
    def from_views(cls, views: Sequence[BoardView]) -> Observations:
        """Pad the views. Raises InputError where a corner lies outside its board, comes twice, or one name means
        boards of two sizes."""
        boards: dict[str, Board] = {}
        for view in views:
            _check_view(view)
            known = boards.setdefault(view.board.board_id, view.board)
            if known.size != view.board.size or known.square_x_mm != view.board.square_x_mm:
                raise InputError(f"image '{view.image}': board '{known.board_id}' has another size in another view")
        ids = list(boards)
        counts = [b.corner_count for b in boards.values()]
        first_row = np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)
        board = np.array([ids.index(view.board.board_id) for view in views], dtype=np.int64)
        shape = (len(views), max((len(view.grid) for view in views), default=0))
        pixels, corner = np.zeros((*shape, 2)), np.zeros(shape, dtype=np.int64)
        sigma, present = np.ones(shape), np.zeros(shape, dtype=bool)
        for i, view in enumerate(views):
            n = len(view.grid)
            pixels[i, :n] = view.pixels
            corner[i] = first_row[board[i]]
            corner[i, :n] += view.grid[:, 1] * view.board.columns + view.grid[:, 0]
            sigma[i, :n] = view.sigma_px
            present[i, :n] = True
        weight = _weights(sigma, present)
        table = tuple(boards.values())
        return cls(tuple(views), pixels, corner, sigma, weight, present, table, first_row, board)

    def table(self) -> Points:
        """Return the flat corners of all boards, (M, 3) mm."""
        return np.concatenate([board.points() for board in self.boards])

    def with_common_error(self, squared_px: FloatArray, kept: BoolArray) -> Observations:
        """Return the observations with sigmas that explain the residuals: what the corners' own sigmas do not (a lens
        or a board that the model does not follow) is an error common to all corners, so sigma^2 + s^2.

        `squared_px` (V, C) are squared 2-D residuals, `kept` (V, C) the corners to judge by.
        """
        excess = float((0.5 * squared_px - self.sigma_px**2)[kept].mean()) if kept.any() else 0.0
        sigma = np.sqrt(self.sigma_px**2 + max(excess, 0.0))
        return replace(self, weight=_weights(sigma, self.present))

    def subset(self, chosen: IntArray) -> Observations:
        """Return the views `chosen`; the board table stays as it is."""
        return replace(
            self,
            views=tuple(self.views[i] for i in chosen),
            pixels=self.pixels[chosen],
            corner=self.corner[chosen],
            sigma_px=self.sigma_px[chosen],
            weight=self.weight[chosen],
            present=self.present[chosen],
            board=self.board[chosen],
        )

    @property
    def images(self) -> list[str]:
        """Name of the image of each view."""
        return [view.image for view in self.views]


def _check_view(view: BoardView) -> None:
    board, grid = view.board, view.grid
    inside = (grid >= 0).all() and (grid < [board.columns, board.rows]).all()
    if not inside:
        raise InputError(
            f"image '{view.image}': corners outside board '{board.board_id}' ({board.columns}x{board.rows} inner "
            "corners); check the board's size"
        )
    if len(grid) and np.bincount(grid[:, 1] * board.columns + grid[:, 0]).max() > 1:
        raise InputError(f"image '{view.image}': a corner of board '{board.board_id}' comes twice")
    if (view.sigma_px <= 0.0).any():
        raise InputError(f"image '{view.image}': corner sigmas must be positive")


def _weights(sigma: FloatArray, present: BoolArray) -> FloatArray:
    median = float(np.median(sigma[present])) if present.any() else 1.0
    sigma = np.clip(sigma, median / SIGMA_RANGE, median * SIGMA_RANGE)
    return np.where(present, median / sigma, 0.0)
