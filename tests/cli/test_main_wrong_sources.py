"""Sources of a kind that a command does not take: archives, other files, folders without boards."""

from __future__ import annotations

import zipfile
from pathlib import Path

import cv2
import numpy as np
import pytest

from rigkit.cli.main import main


@pytest.mark.parametrize(
    "words",
    [
        "calibrate photos.zip --square-mm 30",
        "calibrate photos.zip",
        "detect photos.zip --board 9x6x30 -o out.csv",
        "validate photos.zip",
    ],
)
def test_archives_of_pictures_are_named(
    words: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    with zipfile.ZipFile("photos.zip", "w") as packed:
        packed.writestr("01.jpg", bytes(range(256)))
    assert main(words.split()) == 2
    assert "is a ZIP archive; unpack it" in capsys.readouterr().err


def test_a_file_of_another_kind_is_not_called_a_session(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("notes.txt").write_text("9x6, 30 mm\n")
    assert main(["calibrate", "notes.txt", "--square-mm", "30"]) == 2
    assert "none of these: a folder of images, a video, a session's file" in capsys.readouterr().err
    Path("calibration.json").write_text('{"schema": "rigkit.calibration/1"}\n')
    assert main(["calibrate", "calibration.json"]) == 2
    assert "none of these: a folder of images, a video, a session's file" in capsys.readouterr().err
    assert main(["validate", "calibration.json"]) == 2
    assert 'JSON; a TOML file with schema = "rigkit.dataset/' in capsys.readouterr().err


def test_an_empty_argument_is_not_the_current_folder(capsys: pytest.CaptureFixture[str]) -> None:
    empty = (["calibrate", "", "--board", "9x6x25"], ["mesh", ""], ["detect", "a.png", "--overlay="])
    for words in (*empty, ["mesh", "."]):
        assert main(words) == 2
        assert ("an argument is empty" in (printed := capsys.readouterr().err)) == (words in empty), printed


def test_a_camera_of_a_rig_that_sees_no_board(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """The board may be described rightly: another camera of the rig sees it."""
    monkeypatch.chdir(tmp_path)
    for camera in ("left", "right"):
        Path(camera).mkdir()
        for k in range(3):
            cv2.imwrite(f"{camera}/{k}.png", np.full((60, 80), 90, np.uint8))
    assert main(["calibrate", "left", "right", "--board", "5x4x20"]) == 2
    assert "of camera 'left'" in (printed := capsys.readouterr().err)
    assert "look whether that camera saw the boards, else leave it out; or check columns and rows" in printed
