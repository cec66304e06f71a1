"""`rigkit detect` from the command line."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from helpers.data import read_grey
from helpers.detection_scenes import single

from rigkit.cli.main import main
from rigkit.core.boards import Board
from rigkit.core.detections import BoardDetection
from rigkit.detection.detect import detect_boards
from rigkit.io.corners.corners_file import read_corners
from rigkit.io.media.images import read_image
from rigkit.workflows.detect import detect_in_images
from rigkit.workflows.options.cameras import DetectOptions, FolderOptions

BOARD_TOML = """schema = "rigkit.board/1"
columns = 9
rows = 6
square_x_mm = 30.0
square_y_mm = 30.0
"""


@pytest.fixture
def images(tmp_path: Path) -> Path:
    folder = tmp_path / "images"
    folder.mkdir()
    for number, turn in enumerate((0.1, 0.4, -0.3)):
        scene = single(Board("a", 9, 6, 30.0, 30.0), [0.2, turn, turn], 600.0)
        cv2.imwrite(str(folder / f"{number}.png"), scene.image(np.random.default_rng(number)))
    (tmp_path / "a9x6.toml").write_text(BOARD_TOML)
    return folder


def test_folder_to_corners_and_overlays_whatever_the_number_of_processes(images: Path, tmp_path: Path) -> None:
    texts = []
    for jobs in ("1", "2"):
        corners = tmp_path / f"corners{jobs}.csv"
        overlays = tmp_path / f"overlay{jobs}"
        arguments = [str(images), "--board", str(tmp_path / "a9x6.toml"), "-o", str(corners)]
        assert main(["detect", *arguments, "--overlay", str(overlays), "--jobs", jobs]) == 0
        texts.append(corners.read_text())
        assert sorted(p.name for p in overlays.iterdir()) == ["0.png", "1.png", "2.png"]
    assert texts[0] == texts[1]
    found = read_corners(tmp_path / "corners1.csv", [Board("a9x6", 9, 6, 30.0, 30.0)])
    assert [len(items) for items in found.values()] == [1, 1, 1]
    assert all(items[0].complete and items[0].board_id for items in found.values())


def test_few_images_are_searched_in_threads_which_need_no_imports(
    images: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("rigkit.workflows.detect.over_items", None)
    corners = tmp_path / "corners.csv"
    assert main(["detect", str(images), "--board", "9x6x30", "-o", str(corners)]) == 0
    found = read_corners(corners, [Board("9x6x30", 9, 6, 30.0, 30.0)])
    assert [len(items) for items in found.values()] == [1, 1, 1]


def camera_file(path: Path, size_px: tuple[int, int] = (640, 480)) -> Path:
    parameters = dict(zip(("fx", "fy", "cx", "cy"), (545.0, 545.0, 318.0, 242.0), strict=True))
    camera = {"model": "pinhole", "size_px": size_px, "parameters": parameters}
    path.write_text(json.dumps({"schema": "rigkit.calibration/1", "camera": camera}))
    return path


def test_a_known_camera_adds_corners_whatever_the_number_of_processes(images: Path, tmp_path: Path) -> None:
    for path in sorted(images.iterdir()):
        image = read_grey(path)
        cv2.line(image, (150, 0), (420, 479), 128, 40)
        cv2.imwrite(str(path), image)
    camera = camera_file(tmp_path / "camera.json")
    counts = {}
    for name, more in (
        ("plain", ["1"]),
        ("one", ["1", "--camera", str(camera)]),
        ("two", ["2", "--camera", str(camera)]),
    ):
        corners = tmp_path / f"{name}.csv"
        arguments = [str(images), "--board", str(tmp_path / "a9x6.toml"), "-o", str(corners), "--jobs", *more]
        assert main(["detect", *arguments]) == 0
        found = read_corners(corners, [Board("a9x6", 9, 6, 30.0, 30.0)])
        counts[name] = sum(len(d.grid) for items in found.values() for d in items if d.board_id)
    assert (tmp_path / "one.csv").read_text() == (tmp_path / "two.csv").read_text()
    assert counts["one"] >= counts["plain"]
    assert counts["one"] > 90


def test_json_is_the_result_on_stdout(images: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["detect", str(images / "0.png"), "--json", "--jobs", "1"]) == 0
    (items,) = json.loads(capsys.readouterr().out).values()
    assert [len(item["pixels"]) for item in items] == [54]


def test_existing_output_stays(images: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    corners = tmp_path / "corners.csv"
    corners.write_text("mine")
    assert main(["detect", str(images), "-o", str(corners), "--jobs", "1"]) == 2
    assert corners.read_text() == "mine"
    assert "--force" in capsys.readouterr().err


@pytest.mark.parametrize(
    "what",
    ["missing", "empty folder", "truncated", "jobs", "camera without board", "camera of another size", "no camera"],
)
def test_bad_input_is_one_line(what: str, images: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "empty").mkdir()
    cut = tmp_path / "cut.png"
    cut.write_bytes((images / "0.png").read_bytes()[:5000])
    board = ["--jobs", "1", "--board", str(tmp_path / "a9x6.toml")]
    arguments = {
        "missing": ["no/such.png"],
        "empty folder": [str(tmp_path / "empty")],
        "truncated": [str(cut), "--jobs", "1"],
        "jobs": [str(images), "--jobs", "0"],
        "camera without board": [str(images), "--camera", str(camera_file(tmp_path / "a.json"))],
        "camera of another size": [str(images), *board, "--camera", str(camera_file(tmp_path / "b.json", (800, 600)))],
        "no camera": [str(images), *board, "--camera", str(tmp_path / "none.json")],
    }[what]
    assert main(["detect", *arguments]) == 2
    error = [line for line in capsys.readouterr().err.splitlines() if line.startswith("rigkit:")]
    assert len(error) == 1


def test_no_board_anywhere_fails_the_check(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    cv2.imwrite(str(tmp_path / "flat.png"), np.full((100, 120), 90, np.uint8))
    assert main(["detect", str(tmp_path / "flat.png"), "-o", str(tmp_path / "c.csv"), "--jobs", "1"]) == 1
    assert "no chessboard" in capsys.readouterr().err
    assert not (tmp_path / "c.csv").exists()


def test_images_of_another_board_name_that_board(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    picture = np.full((420, 480), 255, np.uint8)
    for row in range(5):
        for column in range(6):
            cv2.circle(picture, (70 + 68 * column, 70 + 68 * row), 20, 0, cv2.FILLED, cv2.LINE_AA)
    cv2.imwrite(str(tmp_path / "grid.png"), picture)
    image = str(tmp_path / "grid.png")
    assert main(["detect", image, "--jobs", "1"]) == 1
    assert "they show --board circles:6x5" in capsys.readouterr().err
    assert main(["detect", image, "--board", "aprilgrid:6x6x88,spacing=0.3", "--jobs", "1"]) == 1
    assert "no board 'aprilgrid-6x6x88' found in 1 image; in 1 image a circles board" in capsys.readouterr().err


def test_parts_of_a_larger_board_are_not_taken_for_the_given_one(
    images: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["detect", str(images / "0.png"), "--board", "5x4x30", "--jobs", "1"]) == 0
    assert "seen whole: in 1 image 9 x 6 inner corners are seen, 5 x 4 are declared" in capsys.readouterr().err


def test_a_single_folder_and_board_need_no_list_in_python(images: Path) -> None:
    one, listed = (
        detect_in_images(folder, DetectOptions(boards=board, jobs=1))  # type: ignore[arg-type]
        for folder, board in ((str(images), "9x6x30"), ([images], (Path("9x6x30"),)))
    )
    assert one.found.keys() == listed.found.keys() and len(one.found) == 3
    assert FolderOptions(boards="9x6x30") == FolderOptions(boards=("9x6x30",))  # type: ignore[arg-type]


def test_a_whole_board_of_which_parts_pass_for_the_given_one_is_told(
    images: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    whole = detect_boards(read_image(images / "0.png"))[0]
    inside = whole.grid[:, 0] < 8
    part = BoardDetection("board-8x6x30", 8, 6, whole.grid[inside], whole.pixels[inside], whole.sigma_px[inside])
    monkeypatch.setattr("rigkit.workflows.detect.detect_boards", lambda *_, **__: (part,))
    assert main(["detect", str(images / "0.png"), "--board", "8x6x30", "--jobs", "1"]) == 0
    words = f"check columns and rows: in '{images / '0.png'}' 9 x 6 inner corners are seen, 8 x 6 are declared"
    assert words in capsys.readouterr().err


def test_images_of_a_larger_board_are_told_though_others_show_the_given_one(
    images: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    scene = single(Board("a", 8, 6, 30.0, 30.0), [0.2, 0.1, 0.1], 600.0)
    cv2.imwrite(str(images / "smaller.png"), scene.image(np.random.default_rng(3)))
    assert main(["detect", str(images), "--board", "8x6x30"]) == 0
    words = "check columns and rows: 9 x 6 inner corners are seen in 3 of 4 images, 8 x 6 are declared"
    assert words in capsys.readouterr().err
