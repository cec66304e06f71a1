"""Bad input: one line with the place, the reason and the remedy; the right exit code; no file lost."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from helpers.data import REPOSITORY
from helpers.trihedral_captures import BOARDS, pair_toml, write_manifest

from rigkit.cli.main import main
from rigkit.detection.detect import detect_boards
from rigkit.synthetic.pairs import StereoScene

IMAGES = REPOSITORY / "datasets" / "lab-a" / "images" / "fisheye-general"
CALIBRATION = REPOSITORY / "calib" / "cameras" / "mvca020_fe185" / "calibration.json"

MANIFEST = """
schema = "rigkit.dataset/1"
name = "bad"
{extra}
[[boards]]
id = "a"
columns = {columns}
rows = {rows}
square_mm = 50.0

[[boards]]
id = "b"
columns = {columns}
rows = {rows}
square_mm = 50.0

[[boards]]
id = "c"
columns = {columns}
rows = {rows}
square_mm = 50.0

[[cameras]]
id = "fisheye"
calibration = "{calibration}"

[[pairs]]
id = "pair"
camera1 = "fisheye"
camera2 = "fisheye"
image1 = "{image1}"
image2 = "{image2}"
{pose_type}
boards = ["a", "b", "c"]

[pairs.truth]
angles = [ {{ a = "a", b = "b", value_deg = 90.0, sigma_deg = 0.3, how = "set square" }} ]
"""

Write = Callable[..., Path]


@pytest.fixture
def write(tmp_path: Path) -> Write:
    """Return a function that writes a manifest; what is not given is right."""

    def manifest(**changes: object) -> Path:
        facts: dict[str, object] = {
            "extra": "",
            "columns": 8,
            "rows": 6,
            "calibration": CALIBRATION,
            "image1": IMAGES / "view1.jpg",
            "image2": IMAGES / "view2.jpg",
            "pose_type": 'pose_type = "general"',
        }
        (tmp_path / "dataset.toml").write_text(MANIFEST.format(**(facts | changes)))
        return tmp_path

    return manifest


def run(folder: Path, capsys: pytest.CaptureFixture[str], *more: str) -> tuple[int, str]:
    """Run `validate`; return the exit code and the line that says what is wrong."""
    code = main(["validate", str(folder), "-o", str(folder / "out"), "--no-pictures", "-j", "1", *more])
    lines = [line for line in capsys.readouterr().err.splitlines() if line.startswith("rigkit: ")]
    return code, "\n".join(lines)


def check(code: int, line: str, expected: int, *words: str) -> None:
    assert code == expected
    assert len(line.splitlines()) == 1
    for word in words:
        assert word in line


def test_the_unspoiled_data_set_passes(write: Write, capsys: pytest.CaptureFixture[str]) -> None:
    code, line = run(write(), capsys)
    assert (code, line) == (0, "")


def test_no_such_data_set(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    check(*run(tmp_path / "nowhere", capsys), 2, "nowhere")


def test_missing_image(write: Write, capsys: pytest.CaptureFixture[str]) -> None:
    check(*run(write(image2="gone.jpg"), capsys), 2, "gone.jpg", "pair", "does not exist")


def test_truncated_image(write: Write, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    data = (IMAGES / "view1.jpg").read_bytes()
    (tmp_path / "cut.jpg").write_bytes(data[: len(data) // 2])
    check(*run(write(image1="cut.jpg"), capsys), 2, "cut.jpg", "cut off")


def test_wrong_board_size(write: Write, capsys: pytest.CaptureFixture[str]) -> None:
    # Larger ones may be seen in part: where they end is checked as the measurements are.
    folder = write(columns=11, rows=9)
    assert main(["validate", str(folder), "-o", str(folder / "larger"), "--no-pictures", "-j", "1"]) == 1
    assert "8 x 6 inner corners end: correct the board file" in "".join(capsys.readouterr())
    check(*run(write(columns=7, rows=5), capsys), 2, "7x5", "8x6", "board file")


def test_other_image_size(write: Write, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    image = cv2.imread(str(IMAGES / "view1.jpg"), cv2.IMREAD_GRAYSCALE)
    cv2.imwrite(str(tmp_path / "small.png"), cv2.resize(np.asarray(image), (812, 620)))
    check(*run(write(image1="small.png"), capsys), 2, "812x620", "1624x1240", "mvca020_fe185")


def test_unknown_key(write: Write, capsys: pytest.CaptureFixture[str]) -> None:
    check(*run(write(extra="colour = 3"), capsys), 2, "colour", "dataset.toml")


def test_missing_fact(write: Write, capsys: pytest.CaptureFixture[str]) -> None:
    check(*run(write(pose_type=""), capsys), 2, "pose_type", "pairs")


def test_not_toml(write: Write, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = write()
    (folder / "dataset.toml").write_text("schema = [")
    check(*run(folder, capsys), 2, "dataset.toml")


def test_a_byte_order_mark_and_windows_line_ends_do_not_matter(
    write: Write, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Editors on Windows put them there; both files must be read as without."""
    (tmp_path / "camera.json").write_bytes(b"\xef\xbb\xbf" + CALIBRATION.read_bytes())
    manifest = write(calibration="camera.json", columns=4, rows=4) / "dataset.toml"
    manifest.write_bytes(b"\xef\xbb\xbf" + manifest.read_bytes().replace(b"\n", b"\r\n"))
    code, line = run(tmp_path, capsys)
    check(code, line, 2, "8x6")


def test_without_anything_measured_no_work_is_done(
    write: Write, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    manifest = write() / "dataset.toml"
    manifest.write_text(manifest.read_text().partition("[pairs.truth]")[0])
    monkeypatch.setattr(
        "rigkit.workflows.reconstruction.datasets.load_cameras", lambda *_, **__: pytest.fail("work was done")
    )
    code, line = run(tmp_path, capsys)
    check(code, line, 2, "dataset.toml", "nothing was measured", "[pairs.truth]")


def test_a_spoiled_table_of_the_paper_is_known_before_the_work(
    write: Write, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = tmp_path / "mine"
    folder.mkdir()
    (write() / "dataset.toml").rename(folder / "dataset.toml")
    (tmp_path / "hajder2021").mkdir()
    (tmp_path / "hajder2021" / "planes.csv").write_bytes(b"\xff\xfe")
    monkeypatch.setattr(
        "rigkit.workflows.reconstruction.datasets.load_cameras", lambda *_, **__: pytest.fail("work was done")
    )
    code, line = run(folder, capsys)
    check(code, line, 2, "planes.csv", "not UTF-8")


def test_identical_images_have_no_baseline(write: Write, capsys: pytest.CaptureFixture[str]) -> None:
    check(*run(write(image2=IMAGES / "view1.jpg"), capsys), 3, "pair", "no baseline")


def test_calibration_that_is_no_calibration(write: Write, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "camera.json").write_text('{"schema": "rigkit.calibration/1", "camera": {"model": "nonsense"}}')
    check(*run(write(calibration="camera.json"), capsys), 2, "camera.json")


def test_calibration_with_nan_is_named(write: Write, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    known = json.loads(CALIBRATION.read_text())
    for place in ("parameter", "covariance"):
        spoilt = json.loads(json.dumps(known))
        if place == "parameter":
            spoilt["camera"]["parameters"][next(iter(spoilt["camera"]["parameters"]))] = float("nan")
        else:
            spoilt["covariance"][0][0] = float("nan")
        (tmp_path / "camera.json").write_text(json.dumps(spoilt))
        check(*run(write(calibration="camera.json"), capsys), 2, "camera.json", "NaN", "calibrate again")


def test_name_that_is_no_folder(write: Write, capsys: pytest.CaptureFixture[str]) -> None:
    folder = write()
    manifest = folder / "dataset.toml"
    manifest.write_text(manifest.read_text().replace('name = "bad"', 'name = "../../elsewhere"'))
    check(*run(folder, capsys), 2, "dataset.toml", "'name'", "is no name")


def test_no_process(write: Write, capsys: pytest.CaptureFixture[str]) -> None:
    check(*run(write(), capsys, "-j", "0"), 2, "--jobs 0", "at least one")


def test_unknown_pair(write: Write, capsys: pytest.CaptureFixture[str]) -> None:
    check(*run(write(), capsys, "-p", "nobody"), 2, "nobody", "known: pair")


def test_results_are_not_overwritten(write: Write, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = write()
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "tables.md").write_text("mine")
    check(*run(folder, capsys), 2, "out", "--force")
    assert (tmp_path / "out" / "tables.md").read_text() == "mine"
    assert [p.name for p in (tmp_path / "out").iterdir()] == ["tables.md"]


def test_a_failed_run_leaves_old_results(write: Write, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "tables.md").write_text("mine")
    check(*run(write(image2=IMAGES / "view1.jpg"), capsys, "--force"), 3, "no baseline")
    assert (tmp_path / "out" / "tables.md").read_text() == "mine"
    assert [p.name for p in (tmp_path / "out").iterdir()] == ["tables.md"]


def test_two_boards_are_reconstructed_and_the_missing_third_is_named(
    trihedral: tuple[Path, dict[str, StereoScene]], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    source, scenes = trihedral
    folder = Path(shutil.copytree(source, tmp_path / "two"))
    image = np.asarray(cv2.imread(str(folder / "same2.png"), cv2.IMREAD_GRAYSCALE))
    lost = min(detect_boards(image), key=lambda d: d.pixels[:, 0].mean())
    hull = cv2.convexHull(lost.pixels.astype(np.float32)).astype(np.int32)
    cv2.imwrite(str(folder / "same2.png"), cv2.fillConvexPoly(image.copy(), hull, 90))
    pairs = [pair_toml(scenes["same"], "same", (camera, camera)) for camera in ("regular", "fisheye")]
    (folder / "fisheye.json").write_text("Dear rig,")
    write_manifest(folder, pairs[0], pairs[1].replace('id = "same"', 'id = "of a letter"'))
    code = main(["reconstruct", str(folder), "-o", str(folder / "out"), "-j", "1", "--json"])
    printed = capsys.readouterr()
    assert code == 2
    assert len(list((folder / "out").rglob("*.png"))) == 3
    reported = json.loads(printed.out)
    (pair,) = reported["pairs"]
    corners = sum(board.corner_count for board in BOARDS) - len(lost.pixels)
    assert (pair["pair"], pair["points"], len(pair["boards"])) == ("same", corners, 2)
    assert list(reported["failed"]) == ["of a letter"] and "fisheye.json" in reported["failed"]["of a letter"]
    assert "seen in image 1 only" in printed.err


def test_negative_seed(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["demo", "-o", str(tmp_path / "demo"), "--seed", "-1"]) == 2
    assert "--seed" in capsys.readouterr().err
    assert not (tmp_path / "demo").exists()


def test_image_of_a_few_pixels_is_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    cv2.imwrite(str(tmp_path / "tiny.png"), np.zeros((8, 8), np.uint8))
    assert main(["detect", str(tmp_path / "tiny.png")]) == 2
    assert "tiny.png" in capsys.readouterr().err


def test_unknown_verb_and_no_verb(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["nonsense"]) == 2
    assert capsys.readouterr().err == "rigkit: no verb is called 'nonsense'; rigkit --help lists them\n"
    assert main([]) == 2
    assert "usage: rigkit" in capsys.readouterr().err


@pytest.mark.parametrize(
    "words",
    [
        "demo -o {long}",
        "board 9x6 --square-mm 25 -o {long}",
        "detect {long} --board 9x6x25",
        "detect {image} --board {long}",
        "detect {image} --board 9x6x25 -o {long}.csv",
        "pose {image} --camera {camera} --board {long}",
        "pose {image} --camera {long} --board 9x6x25",
        "calibrate {long} --board 9x6x25",
        "calibrate {images} --board {long}",
        "init {long} --square-mm 25",
        "init {images} --square-mm 25 --calibration {long}",
        "init {images} --square-mm 25 --calibration camera={long}",
        "plan {camera} --board {long}",
        "plan {camera} -r {long}.html",
        "check {camera} {long}",
        "check {camera} {image} --board {long}",
        "coach {long} --board 9x6x25",
        "coach {long} --board 9x6x25 --video {image}",
        "coach new --board 9x6x25 --watch {long}",
        "export {camera} --to opencv -o {long}.yaml",
        "rectify {image} --camera {camera} -o {long}.png",
        "rectify {image} --camera {camera} -o out.png --maps {long}.npz",
        "diff {camera} {long}",
        "certify {camera} --length 800 --distance 1500 -r {long}.html",
        "handeye {long} {image} --camera {camera} --board 9x6x25",
        "reconstruct {long}",
        "reconstruct --images {image} {long} --camera {camera}",
        "reconstruct --images {image} {image} --rig {long}",
        "validate {long}",
        "mesh {long}",
        "schema {long}",
        "history {long}",
        "simulate {long}",
        "diff {camera} {camera} --log-file {long}",
    ],
)
def test_names_that_no_file_system_takes(
    words: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    known = {"image": IMAGES / "view1.jpg", "images": IMAGES, "camera": CALIBRATION, "long": "9" * 600}
    assert main([word.format(**known) for word in words.split()]) == 2
    assert capsys.readouterr().err.splitlines()[-1].startswith("rigkit: ")
    assert not any(tmp_path.iterdir())


def test_overflowing_numbers_are_one_line(tmp_path: Path) -> None:
    """In a process of its own, as the tests keep warnings to themselves."""
    cloud = Path(__file__).parents[1] / "corpus" / "ply" / "point-not-finite.ply"
    words = [sys.executable, "-m", "rigkit", "mesh", str(cloud), "-o", str(tmp_path / "mesh.ply")]
    done = subprocess.run(words, capture_output=True, text=True, check=False)
    assert done.returncode == 2 and len(done.stderr.splitlines()) == 1 and "point-not-finite" in done.stderr


@pytest.mark.parametrize(
    ("words", "reported"),
    [
        ("coach new --board 9x6x25 --port 99999999", "port 99999999"),
        ("coach new --board 9x6x25 --lens 400", "400 degrees"),
        ("coach new --board 9x6x25 --near 500 --far 200", "from 500 to 200 mm"),
        ("coach new --board 9x6x25 --watch nowhere", "'nowhere' is not a folder"),
        ("diff LENS LENS -o map.gif", ".png"),
        ("board identify VIEW --square-mm inf -o new", "--square-mm inf"),
        ("reconstruct --images VIEW SECOND --camera LENS --baseline-mm -5", "baseline"),
        ("reconstruct --images VIEW SECOND --camera LENS --level-sigma-deg nan", "level"),
        ("plan LENS --near 300 --far 100", "from 300 to 100 mm"),
        ("plan LENS --field 500", "500 degrees"),
        ("check LENS VIEW --temperature nan --register new.jsonl", "temperature nan"),
        ("check LENS VIEW --temperature -400 --register new.jsonl", "temperature -400"),
        ("check LENS VIEW --temperature 20", "--register"),
        ("history new.jsonl --temperature 20", "--add"),
        ("export LAB -p regular-general --names a -o x.ply", "--names"),
        ("export LAB -p regular-general --size 640x480 -o x.ply", "--size"),
        ("export cloud.ply -p regular-general -o x.las", "--pair"),
    ],
)
def test_invalid_arguments_of_a_verb_are_one_line(
    words: str, reported: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    places = {
        "LENS": CALIBRATION,
        "VIEW": IMAGES / "view1.jpg",
        "SECOND": IMAGES / "view2.jpg",
        "LAB": IMAGES.parents[1],
    }
    monkeypatch.chdir(tmp_path)
    code = main([str(places.get(word, word)) for word in words.split()])
    check(code, capsys.readouterr().err.strip(), 2, reported)
    assert not list(tmp_path.glob("*.*"))


def test_bad_arguments_are_one_line(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as stop:
        main(["diff", "a.json", "b.json", "--nonsense"])
    assert stop.value.code == 2
    printed = capsys.readouterr().err
    assert printed == "rigkit: diff: unrecognized arguments: --nonsense; see rigkit diff --help\n"


def test_words_that_are_nearly_right_are_proposed(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        main(["board", "9x6", "--sqare-mm=25", "-o", "x"])
    assert "unrecognized arguments: --sqare-mm=25; did you mean --square-mm?" in capsys.readouterr().err
    assert main(["calibrat", "photos"]) == 2
    assert capsys.readouterr().err == "rigkit: no verb is called 'calibrat'; did you mean calibrate?\n"


def test_a_camera_too_many_is_no_data_set(capsys: pytest.CaptureFixture[str]) -> None:
    for words in ("--images a.png b.png --camera a.json b.json", "b.json a.png --rig rig.json"):
        assert main(["reconstruct", *words.split()]) == 2
        assert "'b.json' is taken for a DATASET; images follow --images" in capsys.readouterr().err


def test_a_folder_behind_r_is_not_taken_for_the_page(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["calibrate", "-r", str(tmp_path), "--square-mm", "25"]) == 2
    assert capsys.readouterr().err.endswith("give -r last\n")
