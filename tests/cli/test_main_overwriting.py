"""--force replaces results, never an input: images, sessions, calibrations, manifests."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
from helpers.data import REPOSITORY

from rigkit.cli.main import main
from rigkit.io.corners.corners_file import read_corners
from rigkit.io.manifests.manifest import load_dataset
from rigkit.io.manifests.session import files_of_session, load_session

LAB = REPOSITORY / "datasets" / "lab-a"
LENS = REPOSITORY / "calib" / "cameras" / "mvca020_r61" / "calibration.json"


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A pair, its board, a calibration and a session."""
    pair = LAB / "images" / "regular-general"
    for k in (1, 2):
        shutil.copy(pair / f"view{k}.jpg", tmp_path / f"view{k}.png")
    shutil.copy(LENS, tmp_path / "camera.json")
    shutil.copy(LENS, tmp_path / "other.json")
    (tmp_path / "board.toml").write_text('schema = "rigkit.board/1"\ncolumns = 8\nrows = 6\nsquare_mm = 50\n')
    (tmp_path / "session.toml").write_text(
        'schema = "rigkit.session/1"\nimages = "view*.png"\nboard = "board.toml"\nmodel = "brown"\n'
    )
    text = (LAB / "dataset.toml").read_text(encoding="utf-8").replace("../../calib", str(REPOSITORY / "calib"))
    (tmp_path / "dataset.toml").write_text(text.replace("images/regular-general/view1.jpg", "pair/cloud.png"))
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.mark.parametrize(
    "command",
    [
        "detect view1.png view2.png --overlay .",
        "detect view1.png -o view1.png",
        "detect view1.png --board board.toml -o board.toml",
        "rectify view1.png --camera camera.json -o view1.png",
        "rectify view1.png --camera camera.json -o ../{here}/view1.png",
        "export camera.json --to kalibr -o camera.json",
        "calibrate session.toml -o session.toml",
        "calibrate session.toml -o board.toml",
        "calibrate session.toml -o new.json -r board.toml",
        "calibrate session.toml -o corners.json",
        "calibrate session.toml --export opencv -o new.json -r new-opencv.yaml",
        "export camera.json --to ros -o camera.json",
        "calibrate session.toml -o new.json -r new.json",
        "diff camera.json other.json -o other.json",
    ],
)
def test_no_input_is_lost(command: str, folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    before = {path.name: path.read_bytes() for path in folder.iterdir()}
    assert main([*command.format(here=folder.name).split(), "--force"]) == 2
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 1 and "cannot write" in lines[0]
    assert {path.name: path.read_bytes() for path in folder.iterdir()} == before


def test_no_image_of_a_data_set_is_lost(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    image = folder / "regular-general" / "cloud.png"
    image.parent.mkdir()
    shutil.copy(LAB / "images" / "regular-general" / "view1.jpg", image)
    text = (folder / "dataset.toml").read_text().replace("pair/cloud.png", "regular-general/cloud.png")
    second = str(LAB / "images" / "regular-general" / "view2.jpg")
    (folder / "dataset.toml").write_text(text.replace("images/regular-general/view2.jpg", second))
    before = image.read_bytes()
    assert main(["reconstruct", ".", "-p", "regular-general", "-o", ".", "--force", "-j", "1"]) == 2
    assert "it would be lost" in capsys.readouterr().err
    assert image.read_bytes() == before


def test_no_board_truth_or_session_of_a_data_set_is_lost(folder: Path) -> None:
    """Whatever a manifest leads to is an input: its boards, its table of truth, sessions, and what these lead to."""
    (folder / "truth.csv").write_text("pair,quantity,value,sigma,how\n")
    text = (folder / "dataset.toml").read_text()
    rest = text[text.index("[[cameras]]") :]
    rest = rest[rest.index("[[pairs]]") :]
    text = text[: text.index("[[boards]]")]
    boards = "".join(f'[[boards]]\nid = "plane{k}"\nfile = "board.toml"\n' for k in (1, 2, 3))
    cameras = "".join(
        f'[[cameras]]\nid = "{name}"\ncalibration = "camera.json"\nsession = "session.toml"\n'
        for name in dict.fromkeys(re.findall(r'camera[12] = "([^"]+)"', rest))
    )
    (folder / "dataset.toml").write_text(text + boards + cameras + rest)
    read = {path.name for path in load_dataset(folder).inputs}
    assert read >= {"dataset.toml", "board.toml", "session.toml", "camera.json", "corners.json", "view1.png"}


def test_two_sessions_in_one_folder_keep_their_own_results(folder: Path) -> None:
    shutil.copy(folder / "session.toml", folder / "night.toml")
    day, night = load_session(folder / "session.toml"), load_session(folder / "night.toml")
    assert day.result_path.name == "calibration.json" and day.corners_path.name == "corners.json"
    assert night.result_path.name == "night-calibration.json"
    assert night.corners_path.name == "night-corners.json"
    assert night.corners_path in files_of_session(night.path)


@pytest.mark.parametrize("closed", [False, True], ids=["ascii", "stderr closed"])
def test_streams_that_cannot_take_every_letter(tmp_path: Path, closed: bool) -> None:
    """Results in ASCII, a file's name that is not UTF-8, nobody who listens to notes: none of it is a bug of ours."""
    name = os.fsdecode(b"ph\xffoto.png")
    cv2.imwrite(str(tmp_path / "a.png"), np.full((60, 80), 200, dtype=np.uint8))
    shutil.copy(LAB / "images" / "regular-general" / "view1.jpg", tmp_path / name)
    code = "import sys; from rigkit.cli.main import main; sys.exit(main(sys.argv[1:]))"
    done = subprocess.run(
        ["sh", "-c", '"$@" 2>&-' if closed else '"$@"', "sh", sys.executable, "-c", code, "detect", name, "-j", "1"],
        cwd=tmp_path,
        env=os.environ | {"PYTHONIOENCODING": "ascii", "PYTHONPATH": str(REPOSITORY)},
        capture_output=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert b"\\udcff" in done.stdout and b"3 boards in 1 of 1 images" in done.stdout


@pytest.mark.parametrize("full", ["2>/dev/full", ">/dev/full 2>/dev/full", ">&- 2>&-", "<&- 2>/dev/full"])
def test_a_closed_stderr_does_not_change_the_exit_code(folder: Path, full: str) -> None:
    done = subprocess.run(
        ["sh", "-c", f'"$@" {full}', "sh", sys.executable, "-m", "rigkit", "mesh", "nowhere.ply"],
        cwd=folder,
        env=os.environ | {"PYTHONPATH": str(REPOSITORY)},
        capture_output=True,
        check=False,
    )
    assert done.returncode == 2


@pytest.mark.parametrize("name", [b"ph\xffoto.png", b"a\rb.png", b"a\nb.png", b"\x1b[31mred.png", b'<script>,"=1.png'])
def test_names_of_images_that_no_table_expects(name: bytes, folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (folder / "many").mkdir()
    shutil.copy(LAB / "images" / "regular-general" / "view1.jpg", folder / "many" / os.fsdecode(name))
    assert main(["detect", "many", "-j", "1", "-o", "new.csv", "--overlay", "shown"]) == 0
    printed = capsys.readouterr()
    assert "\x1b" not in printed.out + printed.err and len(printed.out.splitlines()) == 2
    (read,) = read_corners(folder / "new.csv")
    assert (folder / "new.csv").read_bytes().decode() and read.endswith(".png")
    shutil.copy(LAB / "images" / "regular-general" / "view2.jpg", folder / "many" / ("2" + os.fsdecode(name)))
    code = main(["init", "many", "--square-mm", "50", "--calibration", "c", "--pose-type", "auto", "-o", "d.toml"])
    if name == b"ph\xffoto.png":
        # TOML is UTF-8: a manifest could not name this image.
        assert code == 2 and "is not UTF-8" in capsys.readouterr().err
    else:
        assert code == 0 and (folder / "d.toml").read_bytes().decode()
