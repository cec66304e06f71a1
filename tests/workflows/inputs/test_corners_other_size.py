"""A board larger than declared is counted in all images that show it, also where it passed for the declared one."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
from helpers.board_scenes import detection

from rigkit.core.boards import Board
from rigkit.core.detections import BoardDetection
from rigkit.core.errors import InputError
from rigkit.io.corners.corner_cache import FoundCorners
from rigkit.io.manifests.session import Session
from rigkit.workflows.inputs.corners import SessionCorners, session_views

DECLARED, SHOWN = Board("a", 8, 6, 30.0, 30.0), Board("a", 9, 6, 30.0, 30.0)
IMAGES = tuple(Path(f"/far/{k}.jpg") for k in range(14))


def seen_as(board: Board) -> FoundCorners:
    one: BoardDetection = detection(board, board.grid() * 30.0 + 40.0, named=board == DECLARED)
    return FoundCorners((640, 480), (one,))


@pytest.mark.parametrize(("readable", "count"), [(True, 14), (False, 6)])
def test_all_images_that_show_the_larger_board_are_counted(
    readable: bool, count: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    def found_in(path: Path, session: Session, camera: None) -> FoundCorners:
        assert not session.boards
        if not readable:
            raise InputError(f"image '{path}' is gone")
        return seen_as(SHOWN)

    monkeypatch.setattr("rigkit.workflows.inputs.corners.found_in", found_in)
    session = Session(
        path=Path("photos"), images=IMAGES, boards=(DECLARED,), model="auto", degree=None, board_shape="auto"
    )
    found = {path.name: seen_as(SHOWN if k < 6 else DECLARED) for k, path in enumerate(IMAGES)}
    corners = SessionCorners(found=found, unreadable={}, source="found in 14 images")
    with pytest.raises(InputError, match=f"9 x 6 inner corners are seen in {count} of 14 images, 8 x 6 are declared"):
        session_views(session, corners)
    # The first calibration asks, too, and its error is not read.
    with pytest.raises(InputError, match="seen in 6 of 14 images"):
        session_views(session, replace(corners, source=""))
