"""A board that was identified in images is not looked for in them again."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest

from rigkit.core.boards import Board
from rigkit.detection.unknown import BoardGuess
from rigkit.workflows.inputs import identify_board
from rigkit.workflows.inputs.identify_board import suggestion, why_not_detected

SHOWN = Board("board", 9, 6, 1.0, 1.0)


def test_images_are_looked_at_again_only_for_another_board_or_if_they_changed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    looked: list[int] = []

    def guess(paths: Sequence[Path], _: object) -> tuple[BoardGuess, list[tuple[str, np.ndarray]], None]:
        looked.append(len(paths))
        return BoardGuess(board=SHOWN, images=tuple(range(len(paths)))), [], None

    monkeypatch.setattr(identify_board, "_guess", guess)
    images = [tmp_path / f"{k}.png" for k in range(4)]
    for path in images:
        path.write_bytes(b"")
    assert suggestion(images).words is not None
    # Of a rig, the images of one camera.
    assert why_not_detected(images[:2], [Board("b", 9, 6, 30.0, 30.0)]) is None
    assert looked == [4]
    other = [Board("b", 8, 6, 30.0, 30.0)]
    assert why_not_detected(images[:2], other) == "in 2 images 9 x 6 inner corners are seen, 8 x 6 are declared"
    assert looked == [4, 2]
    os.utime(images[0], ns=(1, 1))
    assert why_not_detected(images, [Board("b", 9, 6, 30.0, 30.0)]) is None
    assert looked == [4, 2, 4]
