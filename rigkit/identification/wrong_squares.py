"""Finds boards whose squares were declared with a wrong size.

A board whose squares are wrong by a tenth does not fit the others and is not identified. The others determine the
relative pose of the cameras, and the scale of a board that both images show is then the only unknown.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from rigkit.cameras.base import Camera
from rigkit.core.arrays import FloatArray
from rigkit.core.boards import Board
from rigkit.core.detections import BoardDetection
from rigkit.core.errors import DegenerateError
from rigkit.geometry.board_pose import point_residuals
from rigkit.identification.assignments import ranked_assignments
from rigkit.identification.board_matches import BoardMatch, ImagePair
from rigkit.identification.placements import SAME_SQUARE_REL, BoardKind, board_kinds, describe


@dataclass(frozen=True, eq=False, slots=True)
class FittingSquares:
    """A board that fits the others of its pair with squares of another size.

    Attributes
    ----------
    boards : those it may be, which were declared alike.
    factor : true over declared size of its squares.
    where : description of its detection in image 1.
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
    """Return the boards that fit all others of a pair with squares of another size; arguments as in `identify_pair`.

    Of two boards either may be the wrong one. The result is empty if the others do not fit each other, or if the
    remaining detections fit at no size, or at about the declared one.
    """
    pair = ImagePair.of((detections1, detections2), board_kinds(boards), (camera1, camera2))
    out = []
    for k, kind in enumerate(pair.kinds):
        sized = [
            (*_sized(pair, match, pose), match.index[0]) for pose, free in _poses_by_others(pair, k) for match in free
        ]
        off, factor, first = min(sized, default=(np.inf, 1.0, 0))
        # A difference within the tolerance of one kind does not explain why a board was not identified.
        if off <= 1.0 and abs(factor - 1.0) > SAME_SQUARE_REL:
            out.append(FittingSquares(kind.boards, factor, describe(pair.views[0].detections[first])))
    return tuple(out)


def _poses_by_others(pair: ImagePair, k: int) -> Iterator[tuple[FloatArray, list[BoardMatch]]]:
    """Yield each cam2_from_cam1 (4, 4) at which all boards but one of kind `k` fit, with the matches of that kind among
    the remaining detections."""
    kinds = pair.kinds
    one_less = [BoardKind(kind.boards[:-1] or kind.boards) if j == k else kind for j, kind in enumerate(kinds)]
    of_others = [match for match in pair.matches if match.kind != k or len(kinds[k].boards) > 1]
    if not of_others:
        return
    try:
        ranked = ranked_assignments(replace(pair, kinds=one_less, matches=of_others))
    except DegenerateError:
        return
    for assignment in ranked:
        if len(assignment.matches) == sum(len(kind.boards) for kind in kinds) - 1:
            taken = {at for match in assignment.matches for at in enumerate(match.index)}
            free = [match for match in pair.matches if match.kind == k and not taken & set(enumerate(match.index))]
            yield assignment.pose.cam2_from_cam1, free


def _sized(pair: ImagePair, match: BoardMatch, cam2_from_cam1: FloatArray) -> tuple[float, float]:
    """Return the rms residual in image 2, in units of the gate, of a board posed in image 1 at its best size, and the
    factor f of that size.

    A board of f times the size is f times as far away, with corners at f X. Image 2 sees them along rays r with
    r x (f R X + t) = 0, which is linear in f.
    """
    second, cam1_from_board = match.index[1], match.cam_from_board[0]
    observed = pair.views[1].observations[second]
    placed = pair.points(match, 1) @ cam1_from_board[:3, :3].T + cam1_from_board[:3, 3]
    turned = placed @ cam2_from_cam1[:3, :3].T
    scaled_part = np.cross(observed.rays, turned)
    constant_part = np.cross(observed.rays, np.broadcast_to(cam2_from_cam1[:3, 3], turned.shape))
    factor = -float((scaled_part * constant_part).sum() / (scaled_part**2).sum())
    if factor <= 0.0:
        return np.inf, factor
    off, _ = point_residuals(observed.rays, observed.bases, factor * turned + cam2_from_cam1[:3, 3])
    return float(np.sqrt((off**2).sum(axis=1).mean()) / pair.views[1].gate_px[second]), factor
