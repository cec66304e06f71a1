"""Giving boards that look alike the names that a person uses for them, after a rig of boards was solved."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

from rigkit.calibration.result import Calibration
from rigkit.calibration.rig.board_rig import BoardRig
from rigkit.calibration.rig.result import RigCalibration, RigCamera


def renamed(rig: RigCalibration, names: Mapping[str, str]) -> RigCalibration:
    """Return the rig with boards called otherwise, `names` from old to new; they must be of one size and squares."""
    boards = {b.board.board_id: b.board for target in rig.board_rigs for b in target.boards}

    def target(old: BoardRig) -> BoardRig:
        placed = tuple(
            replace(b, board=boards[names.get(b.board.board_id, b.board.board_id)]) if b.board.board_id in names else b
            for b in old.boards
        )
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
