"""Check the declared numbers of columns and rows of chessboards against where the boards end in both images.

A smaller board passes for a part of the declared one. The colours of its squares alternate up to the line on which the
declaration has further corners, and no further. A cover alternates nowhere, and rarely ends on such a line; in two
images from different places it does so only if it lies on the board. Beyond the declared corners of a larger board its
colours alternate further, the other way round.
"""

from __future__ import annotations

from collections.abc import Sequence
from enum import Enum
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rigkit.cameras.base import Camera
from rigkit.core.arrays import BoolArray, IntArray, Pixels
from rigkit.core.boards import Board
from rigkit.core.patterns.chessboard import Chessboard
from rigkit.detection.saddles.response import sample
from rigkit.geometry.rigid3 import Rigid3
from rigkit.reconstruction.pairing import MatchedPair
from rigkit.validation.check import Check
from rigkit.validation.declarations import MAX_DECLARED_SIGMAS

BESIDE_LINE = 0.15
"""Distance from the line of an end, in squares, at which colours are compared: 2 px or more where corners are found,
so that blur leaves most of the contrast; the pose predicts the line several times better."""
HALF_CONTRAST = 0.5
"""Contrast over that of the squares of the last corners: 1 within a square, 0 beyond the board, -1 in a next square."""
MIN_SHARE_ENDING = 0.75
"""Share of the pairs of squares along a side whose contrast ends there; single ones may be covered or in glare."""
MIN_PAIRS_IN_IMAGE = 3
"""Smallest number of such pairs within an image: two of noise end there by chance once in twenty times."""


class BeyondCorners(Enum):
    """What follows the last corners along an axis: a whole square with which the board ends, a square and another one
    of the other colour, or neither."""

    ENDS = "ends"
    GOES_ON = "goes on"
    UNKNOWN = "unknown"


def contradicted_counts(pair: MatchedPair, images: Sequence[NDArray[Any]]) -> tuple[Check, ...]:
    """Return a failed check for every chessboard with fewer or more columns or rows than declared.

    Fewer: both ends of its columns (rows) must be visible in at least one of the two images (H, W), and no image that
    has room for more may show anything else there. More: in one image squares go on where the declared ones all have
    their corners.
    """
    moves = Rigid3.identity(), pair.identity.cam2_from_cam1
    cameras = pair.camera1, pair.camera2
    by_id = {board.board_id: board for board in pair.boards}
    checks = []
    for detections in pair.identity.pairs():
        board = by_id[str(detections[0].board_id)]
        if not isinstance(board.pattern, Chessboard):
            continue
        pose = pair.identity.cam1_from_board[board.board_id]
        views = [(image, camera, move @ pose) for image, camera, move in zip(images, cameras, moves, strict=True)]
        grid = np.concatenate([detection.grid for detection in detections])
        corners = grid.min(axis=0), grid.max(axis=0)
        sides = [[_side(views, board, corners, axis, up) for up in (False, True)] for axis in (0, 1)]
        seen = _corners_shown(np.ptp(grid, axis=0) + 1, board.size, sides)
        size = " x ".join(map(str, seen))
        checks += [
            _check(board, axis, seen[axis], size, len(grid)) for axis in (0, 1) if seen[axis] != board.size[axis]
        ]
    return tuple(checks)


def _corners_shown(
    count: IntArray, declared: tuple[int, int], sides: Sequence[Sequence[BeyondCorners]]
) -> tuple[int, int]:
    """Return columns and rows of corners by the `sides` (before the first, beyond the last) of a grid of `count` (2,)
    corners along each axis; where the sides do not contradict them, those declared."""

    def along(own: int, size: int, ends: Sequence[BeyondCorners]) -> int:
        if own < size:
            return own if all(end is BeyondCorners.ENDS for end in ends) else size
        return own + int(BeyondCorners.GOES_ON in ends)

    def shown(turned: bool) -> tuple[int, int]:
        first, second = (along(int(count[k]), declared[k ^ turned], sides[k]) for k in (0, 1))
        return (second, first) if turned else (first, second)

    # A part may also lie on the board the other way round, so that the ends of its rows are taken for those of columns.
    fits = bool(count[0] <= declared[1] and count[1] <= declared[0])
    return declared if fits and shown(True) == declared else shown(False)


def _side(
    views: Sequence[tuple[NDArray[Any], Camera, Rigid3]],
    board: Board,
    corners: tuple[IntArray, IntArray],
    axis: int,
    up: bool,
) -> BeyondCorners:
    """Return what is one square beyond the last corners along an axis (`up`), or before its first; views: image,
    camera, and its pose of the board."""
    first, last = corners
    edge, out = (last[axis], 1.0) if up else (first[axis], -1.0)
    along = np.arange(first[1 - axis] - 1, last[1 - axis] + 1) + 0.5
    places = np.empty((3, len(along), 2))
    places[..., 1 - axis] = along
    places[..., axis] = (edge + out * np.array([0.5, 1.0 - BESIDE_LINE, 1.0 + BESIDE_LINE]))[:, None]
    points = np.concatenate([places * board.squares_mm, np.zeros((*places.shape[:-1], 1))], axis=-1)
    found = {_side_in(image, *camera.project(pose.apply(points))) for image, camera, pose in views} - {None}
    if BeyondCorners.GOES_ON in found:
        # Of a larger board the two images may show different columns: where one ends, the other goes on.
        return BeyondCorners.GOES_ON
    return found.pop() or BeyondCorners.UNKNOWN if len(found) == 1 else BeyondCorners.UNKNOWN


def _side_in(image: NDArray[Any], pixels: Pixels, valid: BoolArray) -> BeyondCorners | None:
    """Return what the contrast of adjacent squares does between the second and third row of pixels (3, N, 2), of which
    the first is in their middle; None if too few are in the image."""
    inside = valid & ((pixels >= 0.0) & (pixels <= np.array(image.shape[::-1]) - 1.0)).all(axis=-1)
    pairs = (inside[:, 1:] & inside[:, :-1]).all(axis=0)
    if np.count_nonzero(pairs) < MIN_PAIRS_IN_IMAGE:
        return None
    levels = sample(image, np.where(inside[..., None], pixels, 0.0)).astype(np.float64)
    square, before, beyond = np.diff(levels, axis=1)[:, pairs]
    enough = HALF_CONTRAST * np.median(np.abs(square))
    is_square = before * np.sign(square) > enough
    for side, there in (
        (BeyondCorners.ENDS, np.abs(beyond) < enough),
        (BeyondCorners.GOES_ON, -beyond * np.sign(square) > enough),
    ):
        if np.mean(is_square & there) >= MIN_SHARE_ENDING:
            return side
    return BeyondCorners.UNKNOWN


def _check(board: Board, axis: int, count: int, size: str, corners: int) -> Check:
    """Return the failed check of the number of columns (axis 0) or rows, which has no uncertainty."""
    declared = board.size[axis]
    shown = f"where {size} inner corners end" if count < declared else f"{size} inner corners or more"
    return Check(
        name=f"{('columns', 'rows')[axis]} {board.board_id}",
        kind="board size",
        unit="corners",
        measured=float(declared),
        measured_sigma=0.0,
        how=f"declared; the images show {shown}: correct the board file",
        ours=float(count),
        our_sigma=0.0,
        difference=float(count - declared),
        combined_sigma=abs(declared - count) / MAX_DECLARED_SIGMAS,
        k=MAX_DECLARED_SIGMAS,
        limit_k=0.0,
        passed=False,
        count=corners,
    )
