"""Cameras of a rig that see different parts of a board at one moment, in images of one name."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from helpers.stereo_pictures import RIGHT_FROM_LEFT

from rigkit.cli.main import main
from rigkit.io.calibrations.rig_file import load_rig
from rigkit.workflows.checks.check import load_monitored

COVERED = {"01": {"left": 240, "right": 138}, "02": {"left": 311, "right": 184}, "05": {"left": 294, "right": 259}}
"""Frames in which something stands before the board, for the left camera from this column on, for the right one up to
it: of the first they see grids of two sizes, of the others of one size, but of the two ends of the board."""
NEAR_MM, NEAR_RAD = 0.6, 3e-3


@pytest.fixture(scope="module")
def cut(pictures: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder a camera, with files of one name; in some the two cameras see different parts of the board."""
    folder = tmp_path_factory.mktemp("cut")
    for side in ("left", "right"):
        (folder / side).mkdir()
        for path in pictures.glob(f"{side}*.jpg"):
            image = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
            assert image is not None
            number = path.stem.removeprefix(side)
            if number in COVERED:
                column = COVERED[number][side]
                image[:, slice(column, None) if side == "left" else slice(None, column)] = 120
            cv2.imwrite(str(folder / side / f"{number}.png"), image)
    assert (
        main(["calibrate", str(folder / "left"), str(folder / "right"), "--board", "9x6x30", "--model", "brown", "-r"])
        == 0
    )
    return folder


def test_parts_of_boards_are_no_tie_between_cameras(cut: Path) -> None:
    (_, at_left), (_, at_right) = load_rig(cut / "rig.json").values()
    off = at_right @ at_left.inverse() @ RIGHT_FROM_LEFT.inverse()
    assert np.linalg.norm(off.translation_mm) < NEAR_MM
    assert np.linalg.norm(off.rotation - np.eye(3)) < NEAR_RAD


def test_parts_of_boards_are_no_change_of_the_rig(
    cut: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    sides = []
    for number in ("02", "04"):
        for side in ("left", "right"):
            path = tmp_path / side / f"{number}.png"
            path.parent.mkdir(exist_ok=True)
            image = cv2.imread(str(cut / side / path.name), cv2.IMREAD_GRAYSCALE)
            assert image is not None
            # Another image than the one that the rig was calibrated from: a check leaves out those.
            image[0, 0] += 1
            cv2.imwrite(str(path), image)
            sides.append(str(path))
    assert main(["check", str(cut / "rig.json"), *sides]) == 0
    assert "Still holds" in capsys.readouterr().out


def test_partial_boards_are_not_boards_to_plan_with(cut: Path, capsys: pytest.CaptureFixture[str]) -> None:
    files = [cut / "rig.json", *(cut / f"rig-{side}.json" for side in ("left", "right"))]
    for path in files:
        _, boards = load_monitored(path)
        assert [board.board_id for board in boards] == ["board-9x6x30"]
        assert main(["plan", str(path), "-n", "1"]) == 0
        assert "part of" not in capsys.readouterr().out
