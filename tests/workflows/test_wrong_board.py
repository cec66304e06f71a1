"""A board of marks that is declared wrongly is named where the calibration comes to nothing."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from rigkit.benchmark.scenes import one_board
from rigkit.cli.main import main
from rigkit.core.boards import Board
from rigkit.core.patterns.charuco import Charuco

BOARD = Board("c", 7, 7, 30.0, 30.0, pattern=Charuco("DICT_4X4_1000", 22.5))


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    for seed in range(4):
        rng = np.random.default_rng(seed)
        picture = one_board(rng, board=BOARD).render(blur_px=0.7, noise_levels=1.0, rng=rng)
        cv2.imwrite(str(tmp_path / f"{seed}.png"), np.asarray(picture))
    return tmp_path


def test_corners_in_wrong_places_of_a_board_have_their_cause(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Its first rows have their markers where a board of one column more has them: some corners are found."""
    words = "charuco:8x8x30,dictionary=DICT_4X4_1000,marker_mm=22.5"
    assert main(["calibrate", str(folder), "--board", words, "-o", str(folder / "out.json")]) != 0
    said = "".join(capsys.readouterr())
    assert "7 x 7 inner corners are seen, 8 x 8 are declared" in said


def test_mirrored_images_are_named(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for path in folder.glob("*.png"):
        cv2.imwrite(str(path), np.asarray(cv2.imread(str(path), cv2.IMREAD_GRAYSCALE))[:, ::-1])
    words = "charuco:7x7x30,dictionary=DICT_4X4_1000,marker_mm=22.5"
    assert main(["calibrate", str(folder), "--board", words, "-o", str(folder / "out.json")]) != 0
    said = "".join(capsys.readouterr())
    assert "the images are mirrored: '0.png' shows its board only when it is flipped" in said
