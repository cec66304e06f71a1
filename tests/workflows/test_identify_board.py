"""What `identify_board` says beside the board."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from detection_bench.scenes import one_board

from rigkit.cli.main import main
from rigkit.core.boards import Board
from rigkit.core.patterns.aprilgrid import AprilGrid
from rigkit.core.patterns.base import Pattern
from rigkit.core.patterns.charuco import Charuco


@pytest.mark.parametrize("pattern", [AprilGrid(0.3), Charuco("DICT_4X4_50", 30.0)])
def test_two_boards_alike_are_told(pattern: Pattern, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    board = Board("b", 8, 6, 40.0, 40.0, pattern=pattern)
    picture = one_board(np.random.default_rng(0), board=board, max_tilt_deg=10.0).render()
    for name, image in (("one.png", picture), ("two.png", np.hstack([picture, picture]))):
        path = tmp_path / name
        cv2.imwrite(str(path), np.asarray(image))
        assert main(["board", "identify", str(path)]) == 0
        err = capsys.readouterr().err
        assert ("two boards alike in 1 of 1 images, such as 'two.png'" in err) == (name == "two.png")
        assert ("first_marker, first_tag" in err) == (name == "two.png")
