"""Boards whose marks are numbered otherwise than declared are told of rigs, too, good or bad."""

from __future__ import annotations

from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from rigkit.core.boards import Board
from rigkit.core.detections import BoardView
from rigkit.core.findings import Finding
from rigkit.core.patterns.charuco import Charuco
from rigkit.core.progress import silent
from rigkit.workflows.calibration import calibrate

MARKED = Board("marked", 7, 6, 40.0, 40.0, pattern=Charuco("DICT_4X4_100", 30.0))
PLAIN = Board("plain", 7, 6, 40.0, 40.0)


@dataclass(frozen=True)
class Rig:
    """What of a calibrated rig is read."""

    verdicts: tuple[Finding, ...]


def seen(board: Board, corners: int) -> BoardView:
    return BoardView("0.png", board, board.grid()[:corners], np.zeros((corners, 2)), np.full(corners, 0.1))


@pytest.mark.parametrize(
    ("board", "corners", "first", "told"),
    [
        (MARKED, (20, 24), Finding.good("fine"), "look: set first_marker = 3"),
        (MARKED, (20, 42), Finding.good("fine"), None),
        (PLAIN, (20, 24), Finding.good("fine"), None),
        (MARKED, (42, 42), Finding.bad("not fine"), "bad: set first_marker = 3"),
    ],
)
def test_wrong_marks_of_a_rig_are_told_where_no_camera_sees_most_of_a_board(
    monkeypatch: pytest.MonkeyPatch, board: Board, corners: tuple[int, int], first: Finding, told: str | None
) -> None:
    asked = []

    def why(images: Any, boards: Any, progress: Any) -> str:
        asked.append(images)
        return "set first_marker = 3"

    monkeypatch.setattr(calibrate, "why_misplaced", why)
    cameras = {name: SimpleNamespace(images=name, boards=(board,)) for name in ("left", "right")}
    views = [seen(board, count) for count in corners]
    found: Any = calibrate._with_misread(Rig((first,)), SimpleNamespace(cameras=cameras), views, silent)  # type: ignore[arg-type]
    assert [str(one) for one in found.verdicts] == [str(first), *filter(None, [told])]
    assert bool(asked) == (told is not None)
