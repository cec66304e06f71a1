"""Which board's squares were declared of another size, where a pair's boards do not all fit together as listed.

Identifying boards gives up one whose squares are off by a tenth: it fits nowhere beside the others. Those others alone
give the pose of the cameras, and a board that both images show then has one unknown left, its size.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from rigkit.cameras.base import Camera
from rigkit.core.arrays import FloatArray
from rigkit.core.boards import Board
from rigkit.core.detections import BoardDetection
from rigkit.core.errors import DegenerateError, InputError
from rigkit.geometry.board_pose import point_residuals
from rigkit.identification.board_matches import BoardMatch, ImageObservations, matches_between
from rigkit.identification.identify import identify_pair
from rigkit.identification.placements import SAME_SQUARE_REL, BoardKind


@dataclass(frozen=True, eq=False, slots=True)
class FittingSquares:
    """A board with the factor by which its squares, as declared, would have to grow to fit the others of its pair."""

    board: Board
    factor: float


def fitting_squares(
    detections1: Sequence[BoardDetection],
    detections2: Sequence[BoardDetection],
    boards: Sequence[Board],
    camera1: Camera,
    camera2: Camera,
) -> tuple[FittingSquares, ...]:
    """Return the boards that fit all others of a pair with squares of another size, and with which; arguments as of
    `identify_pair`. Of two boards either may be the wrong one."""
    found = (_fitting(detections1, detections2, board, boards, camera1, camera2) for board in boards)
    return tuple(one for one in found if one is not None)


def _fitting(
    detections1: Sequence[BoardDetection],
    detections2: Sequence[BoardDetection],
    board: Board,
    boards: Sequence[Board],
    camera1: Camera,
    camera2: Camera,
) -> FittingSquares | None:
    """Return the size at which `board` fits all the others; None where these do not fit by themselves, the images show
    nothing else, what they show fits at no size, or at about the declared one."""
    others = [other for other in boards if other is not board]
    # What can only be this board is kept out: it would pass for a part of a larger one with squares as large as it has.
    of_others = [
        [d for d in found if sorted((d.columns, d.rows)) != sorted(board.size) or _has_size(others, board.size)]
        for found in (detections1, detections2)
    ]
    try:
        identity = identify_pair(*of_others, others, camera1, camera2)
    except (DegenerateError, InputError):
        return None
    if identity.missing:
        return None
    kinds = (BoardKind((board,)),)
    left1 = ImageObservations.of(_not_among(detections1, identity.detections1), kinds, camera1, "image 1")
    left2 = ImageObservations.of(_not_among(detections2, identity.detections2), kinds, camera2, "image 2")
    pose = identity.cam2_from_cam1.matrix()
    sized = [_sized(match, left1, left2, board, pose) for match in matches_between(left1, left2, kinds)[0]]
    off, factor = min(sized, default=(np.inf, 1.0))
    # Sizes that look alike are no reason why a board was given up.
    return FittingSquares(board, factor) if off <= 1.0 and abs(factor - 1.0) > SAME_SQUARE_REL else None


def _has_size(boards: Sequence[Board], size: tuple[int, int]) -> bool:
    return any(sorted(board.size) == sorted(size) for board in boards)


def _not_among(detections: Sequence[BoardDetection], named: Sequence[BoardDetection]) -> list[BoardDetection]:
    """Return the detections none of whose corners is one of those that are `named`."""
    taken = {tuple(pixel) for one in named for pixel in one.pixels.tolist()}
    return [one for one in detections if not taken & {tuple(pixel) for pixel in one.pixels.tolist()}]


def _sized(
    match: BoardMatch, view1: ImageObservations, view2: ImageObservations, board: Board, cam2_from_cam1: FloatArray
) -> tuple[float, float]:
    """Return by how many gates (rms) image 2 contradicts a board that image 1 places, at its best size, and the factor
    of that size.

    A board of f times the size stands f times as far away, its corners at f X. Image 2 sees them along the rays r where
    r x (f R X + t) = 0, which is linear in f.
    """
    observed = view2.observations[match.second]
    points = board.points(match.placement2.grid_of(view2.detections[match.second]))
    placed = points @ match.cam1_from_board[:3, :3].T + match.cam1_from_board[:3, 3]
    turned = placed @ cam2_from_cam1[:3, :3].T
    grows = np.cross(observed.rays, turned)
    stays = np.cross(observed.rays, np.broadcast_to(cam2_from_cam1[:3, 3], turned.shape))
    factor = -float((grows * stays).sum() / (grows**2).sum())
    if factor <= 0.0:
        return np.inf, factor
    off, _ = point_residuals(observed.rays, observed.bases, factor * turned + cam2_from_cam1[:3, 3])
    return float(np.sqrt((off**2).sum(axis=1).mean()) / view2.gate_px[match.second]), factor
