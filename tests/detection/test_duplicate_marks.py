"""Equal boards in one image are recognised by markers that occur twice."""

from __future__ import annotations

import numpy as np
import pytest

from rigkit.core.boards import Board
from rigkit.core.patterns.charuco import Charuco
from rigkit.detection import duplicate_marks
from rigkit.detection.saddles.response import GreyImage


@pytest.mark.parametrize(("twice", "alike"), [(0, False), (4, False), (20, True)])
def test_a_few_misread_marks_are_no_second_board(twice: int, alike: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of 200 marks 4 are misread for others of the board, somewhere else in the image."""
    board = Board("b", 24, 15, 60.0, 60.0, pattern=Charuco("DICT_4X4_250", 45.0))
    unit = np.array([[0.0, 0.0], [10.0, 0.0], [10.0, 10.0], [0.0, 10.0]])
    number = np.arange(200)
    places = np.stack([30.0 * (number % 20), 30.0 * (number // 20)], axis=1)
    quads = np.concatenate([places, places[:twice] + 800.0])[:, None] + unit
    seen = quads, np.concatenate([number, number[:twice]])

    def marks(_: GreyImage, __: Board) -> tuple[np.ndarray, np.ndarray]:
        return seen

    monkeypatch.setattr(duplicate_marks, "_marks", marks)
    assert (duplicate_marks.duplicate_boards(np.zeros((40, 40), np.uint8), [board]) is not None) is alike
