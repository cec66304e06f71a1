"""Which board's squares were declared of another size, where a pair's boards do not all fit together as listed.

Identifying boards gives up one whose squares are off by a tenth: it fits nowhere beside the others. Those others alone
give the pose of the cameras, and a board that both images show then has one unknown left, its size.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from rigkit.cameras.base import Camera
from rigkit.core.arrays import FloatArray
from rigkit.core.boards import Board
from rigkit.core.detections import BoardDetection
from rigkit.core.errors import DegenerateError
from rigkit.geometry.board_pose import point_residuals
from rigkit.identification.assignments import ranked_assignments
from rigkit.identification.board_matches import BoardMatch, ImageObservations, matches_between
from rigkit.identification.placements import SAME_SQUARE_REL, BoardKind, board_kinds, describe


@dataclass(frozen=True, eq=False, slots=True)
class FittingSquares:
    """A board that fits the others of its pair with squares of another size.

    Attributes
    ----------
    boards : those that it may be: they were declared alike.
    factor : by which its squares would have to grow.
    where : words by which a person finds it in image 1.
    """

    boards: tuple[Board, ...]
    factor: float
    where: str


def fitting_squares(
    detections1: Sequence[BoardDetection],
    detections2: Sequence[BoardDetection],
    boards: Sequence[Board],
    camera1: Camera,
    camera2: Camera,
) -> tuple[FittingSquares, ...]:
    """Return the boards that fit all others of a pair with squares of another size; arguments as of `identify_pair`.

    Of two boards either may be the wrong one. Nothing is returned where the others do not fit by themselves, or what
    else the images show fits at no size, or at about the declared one.
    """
    kinds = board_kinds(boards)
    view1 = ImageObservations.of(detections1, kinds, camera1, "image 1")
    view2 = ImageObservations.of(detections2, kinds, camera2, "image 2")
    matches, _, _ = matches_between(view1, view2, kinds)
    out = []
    for k, kind in enumerate(kinds):
        sized = [
            (*_sized(match, view2, kind.board, pose), match.first)
            for pose, free in _poses_by_others(k, matches, view1, view2, kinds)
            for match in free
        ]
        off, factor, first = min(sized, default=(np.inf, 1.0, 0))
        # Sizes that look alike are no reason why a board was given up.
        if off <= 1.0 and abs(factor - 1.0) > SAME_SQUARE_REL:
            out.append(FittingSquares(kind.boards, factor, describe(view1.detections[first])))
    return tuple(out)


def _poses_by_others(
    k: int,
    matches: Sequence[BoardMatch],
    view1: ImageObservations,
    view2: ImageObservations,
    kinds: Sequence[BoardKind],
) -> Iterator[tuple[FloatArray, list[BoardMatch]]]:
    """Yield each cam2_from_cam1 (4, 4) at which all boards but one of kind `k` fit, with the matches of that kind among
    the detections that are left: two boards may fit in several ways, and the third one tells."""
    one_less = [BoardKind(kind.boards[:-1] or kind.boards) if j == k else kind for j, kind in enumerate(kinds)]
    of_others = [match for match in matches if match.kind != k or len(kinds[k].boards) > 1]
    if not of_others:
        return
    try:
        ranked = ranked_assignments(of_others, view1, view2, one_less)
    except DegenerateError:
        return
    for assignment in ranked:
        if len(assignment.matches) == sum(len(kind.boards) for kind in kinds) - 1:
            first, second = ({getattr(m, side) for m in assignment.matches} for side in ("first", "second"))
            free = [m for m in matches if m.kind == k and m.first not in first and m.second not in second]
            yield assignment.pose.cam2_from_cam1, free


def _sized(
    match: BoardMatch, view2: ImageObservations, board: Board, cam2_from_cam1: FloatArray
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
    scaled_part = np.cross(observed.rays, turned)
    constant_part = np.cross(observed.rays, np.broadcast_to(cam2_from_cam1[:3, 3], turned.shape))
    factor = -float((scaled_part * constant_part).sum() / (scaled_part**2).sum())
    if factor <= 0.0:
        return np.inf, factor
    off, _ = point_residuals(observed.rays, observed.bases, factor * turned + cam2_from_cam1[:3, 3])
    return float(np.sqrt((off**2).sum(axis=1).mean()) / view2.gate_px[match.second]), factor
