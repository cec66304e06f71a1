"""Boards that look alike in a rig's session: named arbitrarily before the solution, and by a rule after it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

from rigkit.calibration.result import Calibration
from rigkit.calibration.rig.board_rig import BoardRig
from rigkit.calibration.rig.result import RigCalibration, RigCamera
from rigkit.core.boards import Board
from rigkit.core.detections import BoardDetection
from rigkit.core.errors import InputError
from rigkit.identification.board_ids import LocatedBoard, assign_board_ids
from rigkit.identification.placements import board_kinds
from rigkit.io.corners.corner_cache import FoundCorners
from rigkit.io.manifests.rig_session import RigSession


def require_distinct(session: RigSession) -> None:
    """Raise InputError if a rig of several cameras has boards that look alike and are not on one mount."""
    if len(session.cameras) < 2:
        return
    for kind in board_kinds(next(iter(session.cameras.values())).boards):
        if len(kind.ids) > 1 and not any(set(kind.ids) <= set(group.boards) for group in session.rigid_boards):
            raise InputError(
                f"{session.path}: boards {', '.join(kind.ids)} look alike, so that images do not tell which is "
                "which; list one of them (copies are matched by their arrangement), or mount them to each other and "
                "list them as [[rigid_boards]]"
            )


def named_as_listed(session: RigSession, found: Mapping[str, FoundCorners]) -> dict[str, FoundCorners]:
    """Return the corners with a board id for every whole board of a group that has none.

    The solution finds out which of the boards that look alike is which, from their relative poses.
    """
    boards = {b.board_id: b for own in session.cameras.values() for b in own.boards}
    groups = [[boards[name] for name in group.boards] for group in session.rigid_boards]
    if not groups:
        return dict(found)
    out = {}
    for image, item in found.items():
        taken = {d.board_id for d in item.detections}
        detections = []
        for detection in item.detections:
            named = None
            if detection.board_id is None:
                named = next((n for group in groups if (n := _vacant(detection, group, taken)) is not None), None)
            if named is not None:
                taken.add(named.board_id)
            detections.append(named or detection)
        out[image] = replace(item, detections=tuple(detections))
    return out


def _vacant(detection: BoardDetection, group: list[Board], taken: set[str | None]) -> BoardDetection | None:
    """Return the detection named as the first board of its size in the group whose id is not `taken`, or None."""
    for turns in (0, 1):
        turned = detection.turned(turns)
        for board in group:
            if board.board_id not in taken and board.size == (turned.columns, turned.rows):
                if turns and board.square_x_mm != board.square_y_mm:
                    continue
                return turned.named(board.board_id)
    return None


def named_by_rule(session: RigSession, rig: RigCalibration) -> RigCalibration:
    """Return the rig with boards that look alike named by the rule of `identification.board_ids`.

    The rule is applied to the first image that shows the most of them, with the session's layout or the listed order.
    """
    boards = {b.board_id: b for own in session.cameras.values() for b in own.boards}
    names: dict[str, str] = {}
    for group in session.rigid_boards:
        kinds = board_kinds([boards[name] for name in group.boards])
        views = [v for v in rig.cameras[0].calibration.views if v.board_id in group.boards]
        images = list(dict.fromkeys(v.image for v in views))
        if not images:
            continue
        most = max(images, key=lambda image: sum(v.image == image for v in views))
        shown = {v.board_id: v.cam_from_board.matrix() for v in views if v.image == most}
        owner = {i: k for k, kind in enumerate(kinds) for i in kind.ids}
        # Boards of one kind that are listed turned have another frame: they keep their names.
        loose = [i for i in shown if boards[i].size == kinds[owner[i]].board.size and len(kinds[owner[i]].ids) > 1]
        located = [LocatedBoard(owner[i], pose, None if i in loose else i) for i, pose in shown.items()]
        found, _ = assign_board_ids(located, kinds, group.layout or None)
        names |= {old: new for old, new in zip(shown, found, strict=True) if old != new}
    # Names that are free again go to the boards without one, so that every board has exactly one.
    free = [n for n in names if n not in names.values()]
    names |= dict(zip([n for n in names.values() if n not in names], free, strict=True))
    return renamed(rig, names) if names else rig


def renamed(rig: RigCalibration, names: Mapping[str, str]) -> RigCalibration:
    """Return the rig with boards renamed, `names` from old to new; they must have the same size and squares."""
    boards = {b.board.board_id: b.board for target in rig.board_rigs for b in target.boards}

    def target(old: BoardRig) -> BoardRig:
        placed = tuple(replace(b, board=boards[names.get(b.board.board_id, b.board.board_id)]) for b in old.boards)
        return replace(old, boards=placed)

    def calibration(old: Calibration) -> Calibration:
        views = tuple(replace(v, board_id=names.get(v.board_id, v.board_id)) for v in old.views)
        shapes = tuple(replace(b, board_id=names.get(b.board_id, b.board_id)) for b in old.boards)
        return replace(old, views=views, boards=shapes)

    def camera(old: RigCamera) -> RigCamera:
        return replace(old, calibration=calibration(old.calibration))

    return replace(
        rig,
        cameras=tuple(camera(c) for c in rig.cameras),
        board_rigs=tuple(target(t) for t in rig.board_rigs),
        left_out=tuple((frame, names.get(board, board), why) for frame, board, why in rig.left_out),
    )
