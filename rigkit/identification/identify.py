"""Ids and orientations of the boards in the two images of a pair, by geometry.

Boards may be different or look alike, and may be symmetric under rotation. Every candidate match of a detection in
image 1 with one in image 2 determines a relative pose of the cameras, which all other boards support or contradict. The
assignment with the smallest joint residual is chosen; its odds against the others say whether it is ambiguous.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from rigkit.cameras.base import Camera
from rigkit.core.arrays import FloatArray
from rigkit.core.boards import Board
from rigkit.core.detections import BoardDetection
from rigkit.core.errors import DegenerateError, InputError
from rigkit.core.truth import MeasuredAngle
from rigkit.geometry.rigid3 import Rigid3
from rigkit.identification.assignments import Assignment, ranked_assignments
from rigkit.identification.board_ids import LocatedBoard, assign_board_ids, first_corner_turn, ids_by_angles
from rigkit.identification.board_matches import BoardMatch, GridPoses, ImageObservations, ImagePair
from rigkit.identification.joint_pose import BoardCorners, BoardObservation, refine_joint
from rigkit.identification.placements import BoardKind, Placement, board_kinds, describe, placements

LOG_ODDS = float(np.log(1000.0))
"""Log odds of a thousand to one, below which two assignments are tied."""
RESIDUAL_FLOOR_PX = 0.01
"""Lower bound of the residuals due to imperfect calibrations and boards."""


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class PairIdentity:
    """Boards of two images, with ids and orientations such that a corner has the same grid index in both.

    Attributes
    ----------
    detections1, detections2 : the identified boards of each image: first those seen in both, in the same order, that of
        the boards listed; then those seen in that image only.
    cam2_from_cam1 : metric relative pose, refined over all corners of the boards seen in both images.
    cam1_from_board : pose of every identified board, from both images if both see it.
    residual_px : rms reprojection error (2-D per corner, both images).
    ambiguous : whether geometry alone does not distinguish the result from another assignment; it is then the one with
        the smallest roll between the cameras, and `notes` says so.
    missing : why a listed board is not in both lists, by board id.
    notes : assumptions, and detections or corners that were left out, in words.
    """

    detections1: tuple[BoardDetection, ...]
    detections2: tuple[BoardDetection, ...]
    cam2_from_cam1: Rigid3
    cam1_from_board: Mapping[str, Rigid3]
    residual_px: float
    ambiguous: bool
    missing: Mapping[str, str]
    notes: tuple[str, ...] = ()

    def pairs(self) -> tuple[tuple[BoardDetection, BoardDetection], ...]:
        """Return (detection in image 1, detection in image 2) of every board seen in both."""
        second = {d.board_id: d for d in self.detections2}
        return tuple((d, second[d.board_id]) for d in self.detections1 if d.board_id in second)


def identify_pair(
    detections1: Sequence[BoardDetection],
    detections2: Sequence[BoardDetection],
    boards: Sequence[Board],
    camera1: Camera,
    camera2: Camera,
    *,
    layout: Mapping[str, str] | None = None,
    angles: Sequence[MeasuredAngle] = (),
) -> PairIdentity:
    """Return the boards of two images with consistent ids and orientations, and the relative pose of the cameras.

    Raises InputError: no boards, unknown ids in `layout`, one id for two detections of an image; DegenerateError: no
    listed board is seen in both images.

    Parameters
    ----------
    detections1, detections2 : of the two images; given board ids are kept.
    boards : the boards that may be visible.
    camera1, camera2 : the calibrated cameras of the two images.
    layout : sides of boards that look alike, by board id: "left", "right", "floor", "ceiling" or "back" (see
        `rigkit.identification.board_ids`, also for the rule without a layout).
    angles : measured between boards; they identify boards that look alike and are not in the layout.

    Notes
    -----
    With n boards in both images the joint fit has 6 (n - 1) fewer parameters than the free fit, in which every board
    has its own pose in every image. The excess of its chi2 is due to noise, calibration errors or a wrong assignment.
    With an unknown scale of the errors the odds of two assignments are (excess_b / excess_a) ** (3 (n - 1)). One board
    alone therefore never decides; several do, unless their arrangement is symmetric. Ties within 1000 : 1 are resolved
    by the smallest roll between the cameras, then by the most corners in common, and reported.
    """
    kinds = _checked_kinds(boards)
    pair = ImagePair.of((detections1, detections2), kinds, (camera1, camera2))
    if not pair.matches:
        raise DegenerateError(_nothing_shared(pair))
    ranked = ranked_assignments(pair)
    best = ranked[0]
    tied = [s for s in ranked if s is best or _log_odds(pair, best, s) < LOG_ODDS]
    winner = min(tied, key=_preference(min(_roll_rad(s) for s in tied), pair.views))
    identity = _result(pair, winner, tied, boards, layout)
    given = {d.board_id for d in (*detections1, *detections2)} | set(layout or ())
    fitting = ids_by_angles(identity.cam1_from_board, [b for b in boards if b.board_id not in given], angles)
    if not fitting:
        return identity
    message = f"boards {', '.join(sorted(fitting[0]))} look alike and were identified by the measured angles"
    if len(fitting) > 1:
        message += f", which {len(fitting)} orders of the names fit: the one with the fewest changes was taken"
    notes = (*identity.notes, f"{message}; give a layout to identify them for certain")
    return replace(_result(pair, winner, tied, boards, layout, fitting[0]), notes=notes)


def _checked_kinds(boards: Sequence[Board]) -> tuple[BoardKind, ...]:
    if not boards:
        raise InputError("identifying boards: no boards are listed; give at least one")
    ids = [b.board_id for b in boards]
    if len(set(ids)) < len(ids):
        raise InputError(f"identifying boards: a board id is listed twice ({', '.join(ids)}); give each board its own")
    return board_kinds(boards)


def _nothing_shared(pair: ImagePair) -> str:
    counts = [sum(bool(k) for k in view.kinds) for view in pair.views]
    listed = ", ".join(f"{i} ({k.board.columns}x{k.board.rows})" for k in pair.kinds for i in k.ids)
    sizes = sorted(
        {
            f"{d.columns}x{d.rows}"
            for view in pair.views
            for d, own in zip(view.detections, view.kinds, strict=True)
            if not own
        }
    )
    others = f"; other grids: {', '.join(sizes)}" if sizes else ""
    return (
        f"no listed board is seen in both images (listed boards in image 1: {counts[0]}, in image 2: {counts[1]}; "
        f"listed: {listed}{others}); check the board sizes and that both images show the same boards"
    )


def _preference(
    least_rad: float, views: tuple[ImageObservations, ImageObservations]
) -> Callable[[Assignment], tuple[float, ...]]:
    """Return the key by which tied assignments are sorted, most likely first; `least_rad` is the smallest roll of all.

    Shifted along a board, a grid changes the roll by noise alone: there the shift counts by which both images show most
    corners in common. Two equal grids of a board that is covered alike are the same corners.
    """

    def key(assignment: Assignment) -> tuple[float, ...]:
        roll = _roll_rad(assignment)
        shared = sum(_shared(match, views) for match in assignment.matches)
        against = sum(match.against_colour for match in assignment.matches)
        quarter_turns = round((roll - least_rad) / (0.5 * np.pi))
        return -len(assignment.matches), against, quarter_turns, -shared, roll

    return key


def _shared(match: BoardMatch, views: tuple[ImageObservations, ImageObservations]) -> int:
    """Return how many corners of a board both its detections show."""
    first, second = (
        placement.grid_of(view.detections[index])
        for placement, view, index in zip(match.placement, views, match.index, strict=True)
    )
    return len(first) + len(second) - len(np.unique(np.concatenate([first, second]), axis=0))


def _roll_rad(assignment: Assignment) -> float:
    """Return the roll of camera 2 relative to camera 1: the twist of the rotation about z."""
    r = assignment.pose.cam2_from_cam1[:3, :3]
    return abs(float(np.arctan2(r[1, 0] - r[0, 1], r[0, 0] + r[1, 1])))


def _log_odds(pair: ImagePair, best: Assignment, other: Assignment) -> float:
    """Return the log odds of the best assignment against another (see the notes of `identify_pair`)."""
    index = [[match.index[v] for match in best.matches] for v in (0, 1)]
    free = sum(float(chi2[own].sum()) for chi2, own in zip(pair.free, index, strict=True))
    joint = sum(float(chi2[own].sum()) for chi2, own in zip(best.chi2_of, index, strict=True))
    seen = [view.observations[k] for view, own in zip(pair.views, index, strict=True) for k in own]
    sigma2 = [np.mean(observation.sigma_px**-2.0) for observation in seen]
    constraints = 6 * (len(best.matches) - 1)
    noise = free / max(2 * sum(len(observation.rays) for observation in seen) - 6 * len(seen), 1)
    floor = max(constraints, 1) * max(noise, RESIDUAL_FLOOR_PX**2 * float(np.mean(sigma2)))
    excess = max(joint - free, floor)
    return 0.5 * constraints * float(np.log((excess + max(other.chi2 - best.chi2, 0.0)) / excess))


def _tie_note(winner: Assignment, others: Sequence[Assignment]) -> str:
    roll = np.degrees(_roll_rad(winner))
    next_roll = np.degrees(min(_roll_rad(s) for s in others))
    what = "one board alone" if len(winner.matches) == 1 else "the arrangement of the boards"
    why = "with the smallest roll" if roll <= next_roll else "that the boards' colours speak for, not the smallest roll"
    return (
        f"ambiguous: {what} fits {len(others) + 1} assignments; the one {why} between the cameras is used "
        f"({roll:.1f} degrees, next {next_roll:.1f}); boards of different sizes would resolve it"
    )


@dataclass(frozen=True, eq=False, slots=True)
class _MatchedBoard:
    """A located board, the indices of its detections in image 1 and 2, and their placements."""

    located: LocatedBoard
    index: tuple[int | None, int | None]
    placement: tuple[Placement, Placement]


def _identified_boards(pair: ImagePair, winner: Assignment) -> tuple[list[_MatchedBoard], list[tuple[int, int]]]:
    """Return the boards of the winner and listed boards in one image only, and the other detections.

    The other detections are (image 0 or 1, index).
    """
    out, views, kinds = [], pair.views, pair.kinds
    for match, pose in zip(winner.matches, winner.pose.cam1_from_board, strict=True):
        names = [view.detections[k].board_id for view, k in zip(views, match.index, strict=True)]
        located = LocatedBoard(match.kind, pose, names[0] or names[1])
        out.append(_MatchedBoard(located, match.index, match.placement))
    vacant = [len(kind.boards) - sum(s.located.kind == k for s in out) for k, kind in enumerate(kinds)]
    left_over = []
    cam1_from_cam = (np.eye(4), np.linalg.inv(winner.pose.cam2_from_cam1))
    for v, view in enumerate(views):
        taken = {s.index[v] for s in out}
        poses = GridPoses(view)
        for n in sorted(set(range(len(view.detections))) - taken, key=lambda n: -len(view.detections[n].grid)):
            taken_names = {s.located.board_id for s in out} - {None}
            free = [] if view.detections[n].board_id in taken_names else view.kinds[n]
            k = next((k for k in free if vacant[k] > 0), None)
            where = placements(view.detections[n], kinds[k])[0] if k is not None else None
            found = poses.placed(n, kinds[k], where) if k is not None and where is not None else []
            if k is None or where is None or not found:
                left_over.append((v, n))
                continue
            vacant[k] -= 1
            located = LocatedBoard(k, cam1_from_cam[v] @ found[0][0], view.detections[n].board_id)
            out.append(_MatchedBoard(located, (n, None) if v == 0 else (None, n), (where, where)))
    return out, left_over


def _result(
    pair: ImagePair,
    winner: Assignment,
    tied: Sequence[Assignment],
    boards: Sequence[Board],
    layout: Mapping[str, str] | None,
    renamed: Mapping[str, str] | None = None,
) -> PairIdentity:
    """Return the winner's boards with ids and orientations, refined with each board's own squares.

    `renamed` maps ids from `assign_board_ids` to the final ones.
    """
    views, kinds = pair.views, pair.kinds
    seen, left_over = _identified_boards(pair, winner)
    names, notes = assign_board_ids([s.located for s in seen], kinds, layout)
    names = [(renamed or {}).get(name, name) for name in names]
    by_id = {b.board_id: b for b in boards}
    centres = [s.located.centre(kinds[s.located.kind].board) for s in seen]
    detections: tuple[dict[str, BoardDetection], dict[str, BoardDetection]] = ({}, {})
    start: dict[str, FloatArray] = {}
    for n, (item, name) in enumerate(zip(seen, names, strict=True)):
        kind, board = kinds[item.located.kind], by_id[name]
        others = [c for k, c in enumerate(centres) if k != n]
        turn = first_corner_turn(item.located, kind, board, others)
        for v in (0, 1):
            index = item.index[v]
            if index is not None:
                placed = item.placement[v].apply(views[v].detections[index], kind.board)
                detections[v][name] = placed.turned(turn).named(name)
        whole = BoardDetection(None, *kind.board.size, np.zeros((0, 2), int), np.zeros((0, 2)), np.zeros(0))
        start[name] = item.located.cam1_from_board @ np.linalg.inv(Placement(turn).board_from_grid(whole, board))
    both = [b.board_id for b in boards if b.board_id in detections[0] and b.board_id in detections[1]]
    first, second = (
        BoardCorners.stack(
            [BoardObservation.of(view.camera, own[i].pixels, own[i].sigma_px, i) for i in both],
            [by_id[i].points(own[i].grid) for i in both],
        )
        for view, own in zip(views, detections, strict=True)
    )
    pose = refine_joint(winner.pose.cam2_from_cam1, np.stack([start[i] for i in both]), (first, second))
    for k, board_id in enumerate(both):
        start[board_id] = pose.cam1_from_board[k]
    corners = np.array([[len(d[i].grid) for d in detections] for i in both])
    contradicting = [s for s in tied if s.differs_from(winner)]
    ties = [_tie_note(winner, contradicting)] if contradicting else []
    lost = [_why_left_over(v, views[v], n) for v, n in left_over]
    ordered = [[*both, *(b.board_id for b in boards if b.board_id in d and b.board_id not in both)] for d in detections]
    return PairIdentity(
        detections1=tuple(detections[0][i] for i in ordered[0]),
        detections2=tuple(detections[1][i] for i in ordered[1]),
        cam2_from_cam1=Rigid3.from_matrix(pose.cam2_from_cam1),
        cam1_from_board={i: Rigid3.from_matrix(m) for i, m in start.items()},
        residual_px=float(np.sqrt(pose.squared_px.sum() / corners.sum())),
        ambiguous=bool(contradicting),
        missing=_missing(boards, detections),
        notes=(*views[0].notes, *views[1].notes, *notes, *lost, *ties),
    )


def _why_left_over(image: int, view: ImageObservations, index: int) -> str:
    what = f"image {image + 1}: {describe(view.detections[index])}"
    if view.kinds[index]:
        return f"{what} fits no board still free: one too many, or moved between the images"
    return f"{what} is none of the boards listed"


def _missing(
    boards: Sequence[Board],
    detections: tuple[Mapping[str, BoardDetection], Mapping[str, BoardDetection]],
) -> dict[str, str]:
    """Return why boards are not in both images, by board id."""
    out = {}
    for board in boards:
        seen = [k for k, found in enumerate(detections, start=1) if board.board_id in found]
        if len(seen) < 2:
            where = f"seen in image {seen[0]} only" if seen else "not seen in either image"
            out[board.board_id] = f"{board.columns}x{board.rows} corners: {where}"
    return out
