"""What identifying the boards of a pair of images found, and the corners that both images share."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from rigkit.arrays import IntArray
from rigkit.detections import BoardDetection
from rigkit.geometry.rigid3 import Rigid3

__all__ = ["PairIdentity", "common_corners"]


@dataclass(frozen=True, eq=False, slots=True)
class PairIdentity:
    """Boards of two images, named and turned so that one physical corner has one grid index in both.

    Attributes
    ----------
    detections1, detections2 : the boards of either image that are known; those seen in both come first, in the order
        of the boards listed, the same board at the same place in both; then those seen in that image only.
    cam2_from_cam1 : relative pose, metric, refined over all corners of the boards seen in both images.
    cam1_from_board : pose of every named board, from both images where both see it.
    residual_px : rms distance (2-D per corner, both images) of the corners from the rigid scene of the winner.
    runner_up_px : the same for the best clearly different assignment of as many boards, however badly it fits;
        infinite where there is none.
    board_residual_px : `residual_px` board by board.
    ambiguous : whether geometry alone cannot tell the winner from another assignment; the one with the smallest roll
        between the cameras was then taken, and `notes` says so.
    missing : why a listed board is not in both lists, by board id.
    notes : what was assumed or left out, in words.
    """

    detections1: tuple[BoardDetection, ...]
    detections2: tuple[BoardDetection, ...]
    cam2_from_cam1: Rigid3
    cam1_from_board: Mapping[str, Rigid3]
    residual_px: float
    runner_up_px: float
    board_residual_px: Mapping[str, float]
    ambiguous: bool
    missing: Mapping[str, str]
    notes: tuple[str, ...] = ()

    def pairs(self) -> tuple[tuple[BoardDetection, BoardDetection], ...]:
        """Return (detection in image 1, detection in image 2) of every board seen in both."""
        second = {d.board_id: d for d in self.detections2}
        return tuple((d, second[d.board_id]) for d in self.detections1 if d.board_id in second)


def common_corners(detection1: BoardDetection, detection2: BoardDetection) -> tuple[IntArray, IntArray, IntArray]:
    """Return grid (N, 2) of the corners seen in both, row by row, and their indices (N,) into either detection.

    >>> d = BoardDetection("a", 3, 2, [[0, 0], [1, 0], [2, 1]], np.zeros((3, 2)), np.ones(3))
    >>> e = BoardDetection("a", 3, 2, [[1, 0], [0, 1], [2, 1]], np.zeros((3, 2)), np.ones(3))
    >>> grid, first, second = common_corners(d, e)
    >>> grid.tolist(), first.tolist(), second.tolist()
    ([[1, 0], [2, 1]], [1, 2], [0, 2])
    """
    width = max(detection1.columns, detection2.columns)
    keys = [d.grid[:, 1] * width + d.grid[:, 0] for d in (detection1, detection2)]
    _, first, second = np.intersect1d(keys[0], keys[1], assume_unique=True, return_indices=True)
    return detection1.grid[first], first, second
