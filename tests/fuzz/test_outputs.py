"""No name of a result destroys an input, and names that cannot be written are refused."""

from __future__ import annotations

import json
import os
import stat
from pathlib import Path

import pytest

from rigkit.cli.main import main

CALIBRATE = "calibrate session.toml --no-cache"
FOLDER = "calibrate pairs --board board.toml --no-cache"
RIG = "calibrate rig-session.toml --no-cache"
CERTIFY = "certify calibration.json --length 3 --distance 500"
INIT = "init pairs --square-mm 30 --calibration calibration.json --pose-type planar"
IMAGES = ("pairs/view1.png", "pairs/view2.png")

WRITES: tuple[tuple[str, str, tuple[str, ...]], ...] = (
    ("detect -j 1 image.png --board floor.toml", "-o", ("image.png", "floor.toml")),
    ("detect -j 1 --board floor.toml --camera calibration.json image.png", "-o", ("calibration.json",)),
    (CALIBRATE, "-o", ("session.toml", "board.toml", "image.png", "corners.json")),
    (f"{CALIBRATE} -o new.json", "-r", ("session.toml", "board.toml", "image.png", "corners.json")),
    (FOLDER, "-o", ("board.toml", *IMAGES)),
    (f"{FOLDER} -o new.json", "-r", ("board.toml", *IMAGES)),
    (RIG, "-o", ("rig-session.toml", "board.toml", "floor.toml", "image.png", "image.jpg")),
    (f"{RIG} -o new.json", "-r", ("rig-session.toml", "board.toml", "floor.toml", "image.png", "image.jpg")),
    ("diff calibration.json calibration.json", "-o", ("calibration.json",)),
    (CERTIFY, "-r", ("calibration.json",)),
    (CERTIFY, "--pdf", ("calibration.json",)),
    ("rectify image.png --camera calibration.json", "-o", ("image.png",)),
    ("export calibration.json --to kalibr", "-o", ("calibration.json",)),
    ("export rig.json --to kalibr", "-o", ("rig.json",)),
    ("export opencv.yaml --to rigkit", "-o", ("opencv.yaml",)),
    ("export dataset.toml --to ply --pair first", "-o",
     ("dataset.toml", "session.toml", "board.toml", "floor.toml", "image.png", "image.jpg", "calibration.json")),
    ("plan calibration.json -n 1", "-r", ("calibration.json",)),
    ("plan --lens 60 --size 320x240 --board board.toml --views 4", "-r", ("board.toml",)),
    (INIT, "-o", ("calibration.json", *IMAGES)),
    ("check calibration.json image.png --board floor.toml", "--fix", ("calibration.json", "image.png", "floor.toml")),
    ("check calibration.json image.png --board floor.toml", "-r", ("floor.toml",)),
    ("plan --lens 60 --size 320x240 --board target.yaml --views 4", "-r", ("target.yaml",)),
    ("calibrate film.avi --board 5x4x30 --model pinhole", "-o", ("film.avi",)),
    ("calibrate film.toml", "-o", ("film.avi", "floor.toml")),
    ("handeye poses.csv pairs --camera calibration.json --board floor.toml", "-o",
     ("poses.csv", "calibration.json", "floor.toml", *IMAGES)),
    ("history history.jsonl", "-r", ("history.jsonl",)),
    ("mesh cloud.ply --depth 3", "-o", ("cloud.ply",)),
    ("calibrate known.toml --no-cache --only-extrinsics calibration.json", "-o", ("known.toml", "calibration.json")),
    ("calibrate added.toml --no-cache --add-camera rig.json", "-o", ("added.toml", "rig.json", "floor.toml")),
    ("rectify image.png --camera calibration.json -o new.png", "--maps", ("image.png", "calibration.json")),
    ("diff rig.json rig.json", "-r", ("rig.json",)),
)  # fmt: skip
"""Commands, the option that names what they write, and what they read."""
COMMANDS = [pytest.param(words, option, id=f"{words.split()[0]} {option}") for words, option, _ in WRITES]
PLACES = ("loop", "pipe", "folder", "image.bmp/below.json", "x" * 300, "/dev/null")


def content(folder: Path) -> dict[str, bytes]:
    """Return what the files hold, but for frames that are kept of a video."""
    files = (p.relative_to(folder) for p in sorted(folder.rglob("*")) if p.is_file())
    return {str(p): (folder / p).read_bytes() for p in files if not p.parts[0].endswith("frames")}


def refused(words: str, capsys: pytest.CaptureFixture[str]) -> str:
    """Run the command, which must be refused in one line; return that."""
    assert main(words.split()) == 2
    (line,) = [line for line in capsys.readouterr().err.splitlines() if line.startswith("rigkit: ")]
    return line


@pytest.mark.parametrize(
    ("words", "option", "read"),
    [pytest.param(w, o, r, id=f"{w.split()[0]} {o} {r}") for w, o, reads in WRITES for r in reads],
)
def test_what_a_command_reads_is_never_written(
    words: str, option: str, read: str, place: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    _film_session(place)
    before = content(place)
    assert "it would be lost" in refused(f"{words} {option} {read} --force", capsys)
    (place / "link.png").symlink_to(read)
    assert "it would be lost" in refused(f"{words} {option} link.png --force", capsys)
    (place / "link.png").unlink()
    assert content(place) == before


def _film_session(place: Path) -> None:
    """A session of which the images are a video's."""
    text = (place / "session.toml").read_text()
    (place / "film.toml").write_text(text.replace("image*.png", "film.avi").replace("board.toml", "floor.toml"))


@pytest.mark.parametrize("name", PLACES)
@pytest.mark.parametrize(("words", "option"), COMMANDS)
def test_names_that_cannot_be_written(
    words: str, option: str, name: str, place: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A link to itself, a pipe, a folder, a file as folder, a name too long, and a device, which a rename replaces."""
    if name == "folder" and words.startswith("rectify") and option == "-o":
        pytest.skip("a folder that exists takes what is rectified")
    ending = ".png" if words.startswith("rectify") else ""
    _film_session(place)
    os.mkfifo(place / f"pipe{ending}")
    (place / f"folder{ending}").mkdir()
    (place / f"loop{ending}").symlink_to(f"loop{ending}")
    (place / f"null{ending}").symlink_to("/dev/null")
    before = content(place)
    where = f"null{ending}" if name == "/dev/null" else f"{name}{ending}"
    line = refused(f"{words} {option} {where} --force", capsys)
    assert where.partition("/below")[0][:40] in line and ";" in line
    assert stat.S_ISCHR(os.stat("/dev/null").st_mode)
    assert content(place) == before


@pytest.mark.parametrize("name", ["calibration.json", "image.png", "dataset.toml", "pipe", "/dev/null", "folder"])
def test_a_log_is_added_to_logs_alone(name: str, place: Path, capsys: pytest.CaptureFixture[str]) -> None:
    os.mkfifo(place / "pipe")
    (place / "folder").mkdir()
    before = content(place)
    assert "--log-file" in refused(f"diff calibration.json calibration.json --log-file {name}", capsys)
    assert content(place) == before


def test_a_log_grows(place: Path) -> None:
    words = "diff calibration.json calibration.json --log-file run.log"
    assert main(words.split()) == 0
    once = (place / "run.log").read_bytes()
    assert main(words.split()) == 0
    assert (place / "run.log").read_bytes().startswith(once) and (place / "run.log").stat().st_size > len(once)


def test_a_session_comes_back_where_the_calibration_fails(place: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The images of this folder are one view twice: they calibrate nothing."""
    before = content(place)
    assert main(["calibrate", "pairs", "--board", "5x4x30", "-o", "new.json", "--force", "--no-cache"]) == 3
    assert content(place) == before


@pytest.mark.parametrize(
    ("given", "output", "code"),
    [
        (["pairs"], "-r", 3),
        (["film.avi"], "-o new.json", 3),
        # Both cameras have the same picture.
        (["pairs", "again"], "-o new.json", 2),
    ],
)
def test_a_failed_calibration_names_the_given_source(
    given: list[str], output: str, code: int, place: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The session that was made of it is gone again; of several cameras the one at fault has its folder's name."""
    (place / "again").mkdir()
    (place / "again" / "view1.png").write_bytes((place / "image.png").read_bytes())
    words = ["calibrate", *given, "--board", "5x4x30", "--model", "pinhole", "--no-cache", *output.split()]
    assert main(words) == code
    (line,) = [line for line in capsys.readouterr().err.splitlines() if line.startswith("rigkit: ")]
    assert any(f"'{name}'" in line for name in given) and "session.toml" not in line, line
    assert not list(place.glob("new-session.toml")) and not (place / "pairs/session.toml").exists()


def test_a_file_that_is_no_cache_is_not_replaced_by_one(place: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (place / "corners.json").write_text('{"mine": 1}')
    main(["calibrate", "session.toml", "-o", "new.json"])
    assert (place / "corners.json").read_text() == '{"mine": 1}'
    assert "left as it is" in capsys.readouterr().err
    # A damaged one of ours is.
    (place / "corners.json").write_text('{"schema": "rigkit.corners/1", "ima')
    main(["calibrate", "session.toml", "-o", "new.json"])
    assert '"sha256"' in (place / "corners.json").read_text()


def test_a_folder_of_captures_that_is_a_file(place: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert "is a file, not a folder" in refused("fetch bumblebee2 -o dataset.toml", capsys)


def test_one_unreadable_image_does_not_end_a_manifest(place: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (place / "pairs" / "view3.png").write_bytes((place / "image.png").read_bytes()[:200])
    assert main([*INIT.split(), "-o", "new.toml"]) == 2
    assert (place / "new.toml").is_file()
    assert "left out: image" in capsys.readouterr().err


@pytest.mark.parametrize("name", ["kalibr.yaml", "cameras.txt", "lens.cameramodel", "ros.yaml"])
def test_formats_of_others_are_recognised_by_content(
    name: str, place: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Nobody says which one it is, and nobody is told to calibrate again."""
    assert main(["diff", name, "kalibr.yaml"]) == 0
    assert "difference 0.0000 px rms" in capsys.readouterr().out


def test_an_unavailable_difference_names_both_files(place: Path, capsys: pytest.CaptureFixture[str]) -> None:
    line = refused("diff calibration.json opencv.yaml", capsys)
    assert "'calibration.json' and 'opencv.yaml'" in line and "one image size" in line


def test_one_changed_number_of_a_covariance_is_no_calibration(place: Path, capsys: pytest.CaptureFixture[str]) -> None:
    data = json.loads((place / "calibration.json").read_text())
    data["frame_covariance"][5][3] = 1e-8
    (place / "changed.json").write_text(json.dumps(data))
    assert "changed.json" in refused("diff changed.json calibration.json", capsys)


@pytest.mark.parametrize("name", ["tables.md", "report.html"])
def test_a_pair_called_as_a_file_of_results_is_refused_before_the_work(
    name: str, place: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(
        "rigkit.workflows.reconstruction.datasets.load_cameras", lambda *_, **__: pytest.fail("work was done")
    )
    text = (place / "dataset.toml").read_text()
    (place / "dataset.toml").write_text(text.replace('id = "first"', f'id = "{name}"'))
    assert name in refused("validate dataset.toml -o new -j 1", capsys)
    (place / "dataset.toml").write_text(text.replace('id = "first"', f'id = "{256 * "x"}"'))
    assert "at most 60" in refused("validate dataset.toml -o new -j 1", capsys)
