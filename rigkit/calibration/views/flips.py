"""Flips of images by programs: viewers that apply the EXIF orientation rotate them, conferencing programs mirror."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from rigkit.core.arrays import Pixels
from rigkit.core.boards import Board
from rigkit.core.detections import BoardView
from rigkit.geometry.rigid3 import Rigid3

FLIP_SIGNS = {
    "rotated by 180 degrees": (-1.0, -1.0),
    "mirrored left to right": (-1.0, 1.0),
    "mirrored top to bottom": (1.0, -1.0),
}
"""The flips of an image, and the signs of its axes (u, v) after each."""


@dataclass(frozen=True, slots=True)
class Flip:
    """A flip of an image by the `signs` of its axes. A board in a mirrored image is numbered `backwards` along its
    columns (0) or its rows (1), so that it stays right-handed: along which, depends on the colours of its squares."""

    signs: tuple[float, float]
    backwards: int | None = None

    def view(self, view: BoardView, middle: Pixels) -> BoardView:
        """Return the view in the image flipped about its `middle` (2,)."""
        grid = view.grid.copy()
        if self.backwards is not None:
            grid[:, self.backwards] = view.board.size[self.backwards] - 1 - grid[:, self.backwards]
        return replace(view, grid=grid, pixels=middle + np.array(self.signs) * (view.pixels - middle))

    def pose(self, cam_from_board: Rigid3, board: Board) -> Rigid3:
        """Return the board's pose in the image flipped about the optical axis."""
        image, on_board, far = np.append(self.signs, 1.0), np.ones(3), np.zeros(3)
        if self.backwards is not None:
            on_board[self.backwards] = -1.0
            far[self.backwards] = (board.size[self.backwards] - 1) * board.squares_mm[self.backwards]
        return Rigid3(image[:, None] * cam_from_board.rotation * on_board, image * cam_from_board.apply(far))
