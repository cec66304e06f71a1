"""One bad input of several ends nothing but itself: the others are done, it is named, and the exit code is right."""

from __future__ import annotations

import importlib
import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
from fuzzing.kinds import KINDS

from rigkit.calibration.hand_eye import HandEye
from rigkit.cli.main import main
from rigkit.coach.guide import GuideOptions
from rigkit.coach.sources import frames_of_folders
from rigkit.core.boards import Board
from rigkit.core.errors import InputError
from rigkit.io.calibrations.history_file import load_history
from rigkit.workflows.capture.coach import open_coach
from rigkit.workflows.handeye import calibrate_hand_eye
from rigkit.workflows.inputs.frames import frames_of_videos
from rigkit.workflows.options.cameras import HandEyeOptions
from rigkit.workflows.options.coach import CoachOptions

BOARD = Board("small", 5, 4, 30.0, 30.0)
CHECK = ["check", "calibration.json", "--board", "floor.toml"]


def cut(source: str, to: str) -> None:
    """Write the first half of a file."""
    data = Path(source).read_bytes()
    Path(to).write_bytes(data[: len(data) // 2])


@pytest.fixture(autouse=True)
def _bad(place: Path) -> None:
    cut("image.png", "pairs/bad.png")


def test_a_check(capsys: pytest.CaptureFixture[str]) -> None:
    """The verdict is that of the images that are whole."""
    codes, words = [], []
    for images in (["pairs/view1.png"], ["pairs/bad.png", "pairs/view1.png"]):
        codes.append(main([*CHECK, *images, "--json"]))
        printed = capsys.readouterr()
        words.append(json.loads(printed.out))
    # Nothing contradicts it, but not all could be looked at.
    assert codes == [0, 2] and words[0]["chance"] == words[1]["chance"]
    assert "pairs/bad.png" in printed.err and len(words[1]["unreadable"]) == 1
    assert main([*CHECK, "pairs/bad.png"]) == 2 and "bad.png" in capsys.readouterr().err


def test_identify_and_handeye(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    assert main(["board", "identify", "pairs"]) == 2
    printed = capsys.readouterr()
    assert "5 x 4" in printed.out and "seen in 2 of 2" in printed.out and "pairs/bad.png" in printed.err
    assert main(["board", "identify", "pairs", "-o", "image.png"]) == 2 and "--square-mm" in capsys.readouterr().err

    def solved(camera: object, views: list[object], stands: list[object], *, board_on_hand: bool) -> HandEye:
        assert len(views) == 2 and not board_on_hand
        return HandEye.__new__(HandEye)

    monkeypatch.setattr("rigkit.workflows.handeye.hand_eye", solved)
    Path("floor.toml").write_text(Path("floor.toml").read_text().replace('"floor"', '"small"'))
    Path("poses.csv").write_text(Path("poses.csv").read_text() + "bad.png,1,2,3,0,0,0,1\n")
    done = calibrate_hand_eye(
        "poses.csv", ["pairs"], HandEyeOptions(camera=Path("calibration.json"), board=Path("floor.toml"))
    )
    assert len(done.unreadable) == 1 and "bad.png" in str(done.unreadable[0])


def test_videos(capsys: pytest.CaptureFixture[str], caplog: pytest.LogCaptureFixture) -> None:
    Path("bad.avi").write_bytes(b"no video")
    assert main(["detect", "-j", "1", "--board", "floor.toml", "bad.avi", "film.avi", "image.png"]) == 2
    printed = capsys.readouterr()
    assert "image.png" in printed.out and "film-frames" in printed.out and "'bad.avi'" in printed.err
    cut("film.avi", "half.avi")
    frames_of_videos({"": Path("half.avi")}, Path("half"), [BOARD])
    assert "half.avi" in caplog.text and "of 8 frames can be decoded" in caplog.text
    # The board is looked for in the video first, and once more for the frames.
    caplog.clear()
    main(["calibrate", "half.avi", "--square-mm", "30"])
    assert caplog.text.count("can be decoded") > 1 and capsys.readouterr().err.count("can be decoded") == 1


def test_frames_go_over_no_other_files(place: Path) -> None:
    folder = place / "film-frames"
    folder.mkdir()
    (folder / "000001.png").write_bytes(b"mine")
    with pytest.raises(InputError, match=r"film-frames.*rename or remove"):
        frames_of_videos({"": Path("film.avi")}, folder, [BOARD])
    assert (folder / "000001.png").read_bytes() == b"mine"
    (folder / "000001.png").unlink()
    first = frames_of_videos({"": Path("film.avi")}, folder, [BOARD])
    (folder / "frames.json").write_text("[" * 100_000)
    assert frames_of_videos({"": Path("film.avi")}, folder, [BOARD]) == first


def test_the_coach(place: Path, capsys: pytest.CaptureFixture[str], caplog: pytest.LogCaptureFixture) -> None:
    options = CoachOptions(folder=place / "coach", boards=("5x4x30",), guide=GuideOptions(boards=(BOARD,)))
    open_coach(options)
    shutil.copy("pairs/bad.png", "coach/images/frame-0001.png")
    shutil.copy("image.png", "coach/images/frame-0002.png")
    (place / "coach/images/frame-one.png").write_bytes(b"not of ours")
    coach = open_coach(options)
    assert len(coach.guide.frames) == 1 and "frame-0001.png" in caplog.text
    assert coach.keeper.keep([np.zeros((4, 5, 3), np.uint8)]) == "frame-0003.png"
    caplog.clear()
    for path in (place / "pairs").iterdir():
        os.utime(path, (0.0, 0.0))  # written long ago
    assert len(list(frames_of_folders([place / "pairs"], until_idle_s=0.1))) == 2 and "bad.png" in caplog.text
    (place / "coach/session.toml").write_bytes(b"\xff\xfe")
    with pytest.raises(InputError, match=r"session\.toml"):
        open_coach(options)


def test_many_data_sets_and_captures(capsys: pytest.CaptureFixture[str]) -> None:
    Path("other/dataset.toml").write_text("schema = ")
    assert main(["validate", "other", "dataset.toml", "-o", "new", "-j", "1", "--no-pictures"]) in (2, 3)
    printed = capsys.readouterr()
    assert "other/dataset.toml" in printed.err and "'dataset.toml'" in printed.err and "small" in printed.out
    first = Path("catalogue/small.toml").read_text()
    Path("away.png").write_bytes(b"another picture")
    text = first.replace('"small"', '"second"') + f'\n[urls]\n"left.png" = "file://{Path("away.png").absolute()}"\n'
    Path("catalogue/a.toml").write_text(text)
    assert main(["fetch", "second", "small", "--catalogue", "catalogue", "-o", "new"]) == 2
    printed = capsys.readouterr()
    assert "second: " in printed.err and "small: 0 files" in printed.out


def test_a_register_loses_nothing(place: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """What several processes add at once is all there; a damaged line is named, before the work."""
    add = (
        "import sys; from dataclasses import replace; from pathlib import Path\n"
        "from rigkit.io.calibrations.history_file import add_entry, load_history\n"
        "entry = load_history('history.jsonl')[0]\n"
        "for k in range(50): add_entry(Path('grown.jsonl'), replace(entry, source=f'{sys.argv[1]}-{k}'))\n"
    )
    programs = [subprocess.Popen([sys.executable, "-c", add, str(k)]) for k in range(2)]
    assert [program.wait(60) for program in programs] == [0, 0]
    assert len({entry.source for entry in load_history("grown.jsonl")}) == 100
    lines = Path("history.jsonl").read_text().splitlines()
    for damage in (lines[1][:30], lines[1].replace("21.5", '"warm"'), "[" * 100_000, lines[1].replace("0.4", "7")):
        Path("history.jsonl").write_text("\n".join([lines[0], damage, *lines[2:]]) + "\n")
        for command in (["history", "history.jsonl"], [*CHECK, "image.png", "--register", "history.jsonl"]):
            assert main(command) == 2
            (line,) = capsys.readouterr().err.splitlines()
            assert "'history.jsonl', line 2" in line and "correct or remove" in line
    assert main([*CHECK, "image.png", "--register", "calibration.json"]) == 2
    assert "cannot add to 'calibration.json'" in capsys.readouterr().err


@pytest.mark.parametrize("name", ["corners.csv", "pairs.csv", "truth.csv", "poses.csv", "times.csv"])
def test_a_cell_without_end(name: str, place: Path) -> None:
    """Python's reader of tables takes cells of 131072 characters."""
    (place / name).write_text((place / name).read_text() + '"' + 140_000 * "x" + "\n")
    kind = next(kind for kind in KINDS.values() if kind.file == name)
    module, _, function = kind.readers[0][0].partition(":")
    with pytest.raises(InputError, match=rf"{name}'?(,|:) line \d+"):
        getattr(importlib.import_module(module), function)(Path(name))


def test_pictures_of_one_channel_and_sixteen_bits_are_shown() -> None:
    from rigkit.workflows.capture.coach import _preview

    for picture in (np.full((8, 8), 200, np.uint8), np.full((8, 8, 3), 200 << 8, np.uint16)):
        shown = cv2.imdecode(np.frombuffer(_preview(picture), np.uint8), cv2.IMREAD_GRAYSCALE)
        assert shown is not None and abs(int(shown[4, 4]) - 200) <= 2


@pytest.mark.parametrize(
    "words",
    [
        "pose image.png --camera turned.json --board floor.toml",
        "handeye poses.csv pairs/view1.png --camera turned.json --board floor.toml",
        "detect -j 1 image.png --camera turned.json --board floor.toml",
        "check turned.json image.png --board floor.toml",
        "rectify image.png --camera turned.json -o out.png",
        "reconstruct --images image.png image.jpg --camera turned.json -o out",
    ],
    ids=lambda words: words.split()[0],
)
def test_an_image_of_another_size_than_its_camera(words: str, capsys: pytest.CaptureFixture[str]) -> None:
    """Nothing can be measured in it; which of the two is wrong nobody can tell, so both are named."""
    data = json.loads(Path("calibration.json").read_text())
    data["camera"]["size_px"].reverse()
    Path("turned.json").write_text(json.dumps(data))
    assert main(words.split()) == 2
    printed = capsys.readouterr().err
    assert "turned.json" in printed and next(word for word in words.split() if word.endswith(".png")) in printed
