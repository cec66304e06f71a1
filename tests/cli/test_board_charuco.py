"""A ChArUco board from the printer to the calibration, by the command line."""

from __future__ import annotations

import json
import xml.etree.ElementTree as ElementTree
from pathlib import Path

import cv2
import numpy as np
import pytest
from detection_bench.scenes import bench_camera, one_board

from rigkit.cli.main import main
from rigkit.core.boards import Board
from rigkit.core.patterns.charuco import Charuco
from rigkit.io.boards.board_file import load_board

PX_PER_MM = 8.0


def printed(path: Path) -> np.ndarray:
    """Return the black rectangles of an SVG sheet as an image of PX_PER_MM."""
    root = ElementTree.fromstring(path.read_text())
    width, height = (float(str(root.get(side)).removesuffix("mm")) for side in ("width", "height"))
    image = np.full((round(height * PX_PER_MM), round(width * PX_PER_MM)), 255, np.uint8)
    for item in root.iter("{http://www.w3.org/2000/svg}rect"):
        if item.get("fill") == "black":
            x, y, w, h = (float(str(item.get(name))) * PX_PER_MM for name in ("x", "y", "width", "height"))
            image[round(y) : round(y + h), round(x) : round(x + w)] = 0
    return image


@pytest.mark.parametrize("extra", [[], ["--legacy"], ["--first-marker", "40", "--marker-mm", "14"]])
def test_what_is_printed_is_what_opencv_reads(extra: list[str], tmp_path: Path) -> None:
    name = tmp_path / "c7x5"
    arguments = ["7x5", "--square-mm", "20", "--charuco", "DICT_5X5_100", *extra]
    assert main(["board", *arguments, "-o", str(name)]) == 0
    board = load_board(name.with_suffix(".toml"))
    assert isinstance(board.pattern, Charuco)
    assert board.pattern.legacy == ("--legacy" in extra)
    ids = np.arange(board.pattern.first_marker, board.pattern.first_marker + 24)
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_5X5_100)
    target = cv2.aruco.CharucoBoard((8, 6), 20.0, board.pattern.marker_mm, dictionary, ids)
    target.setLegacyPattern(board.pattern.legacy)
    corners, numbers, _, found = cv2.aruco.CharucoDetector(target).detectBoard(printed(name.with_suffix(".svg")))
    assert sorted(found.ravel().tolist()) == ids.tolist()
    assert sorted(numbers.ravel().tolist()) == list(range(35))
    order = np.argsort(numbers.ravel())
    grid = corners.reshape(-1, 2)[order].reshape(5, 7, 2) / PX_PER_MM
    # Edges of the picture are rounded to whole pixels.
    assert np.abs(np.diff(grid, axis=1) - [20.0, 0.0]).max() < 1.5 / PX_PER_MM
    assert np.abs(np.diff(grid, axis=0) - [0.0, 20.0]).max() < 1.5 / PX_PER_MM


@pytest.mark.parametrize(
    ("size", "extra"), [("7x5", []), ("7x5", ["--legacy"]), ("8x5", []), ("5x4", []), ("9x6", []), ("12x9", [])]
)
@pytest.mark.parametrize("seen", ["as printed", "slanted", "blurred"])
def test_one_picture_of_the_whole_print_tells_what_it_is(
    size: str, extra: list[str], seen: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Bare paper below the board is where its rows end. The sharp picture has large modules, in whose blocks markers of
    dictionaries with fewer bits are read by chance."""
    name, picture = tmp_path / "board", tmp_path / "picture.png"
    sheet = ["--paper", "a3", "--square-mm", "20" if len(size) == 3 else "15"]
    assert main(["board", size, *sheet, "--charuco", "DICT_5X5_100", *extra, "-o", str(name)]) == 0
    image = cv2.resize(printed(name.with_suffix(".svg")), None, fx=0.35, fy=0.35, interpolation=cv2.INTER_AREA)
    height, width = image.shape
    if seen == "slanted":
        corners = np.array([[0, 0], [width, 0], [width, height], [0, height]], np.float32)
        moved = corners * 0.8 + np.array([[90, 60], [80, 130], [100, 90], [110, 70]], np.float32)
        warp = cv2.getPerspectiveTransform(corners, moved)
        image = cv2.GaussianBlur(cv2.warpPerspective(image, warp, (width, height), borderValue=[90.0]), (0, 0), 1.0)
        noise = np.random.default_rng(0).normal(0.0, 2.0, image.shape)
        image = np.clip(0.7 * image + 30.0 + noise, 0.0, 255.0).astype(np.uint8)
    elif seen == "blurred":
        image = cv2.GaussianBlur(image, (0, 0), 2.0)
    cv2.imwrite(str(picture), image)
    capsys.readouterr()
    assert main(["board", "identify", str(picture)]) == 0
    reported = capsys.readouterr()
    assert f"--board charuco:{size}xMM,dictionary=DICT_5X5_" in reported.out
    # The two patterns are the same board where it has an even number of rows of corners.
    assert ("legacy_pattern=true" in reported.out) == (bool(extra) and int(size.split("x")[1]) % 2 == 1)
    assert "differ in one column" not in reported.err


def test_the_measured_print_keeps_its_markers(tmp_path: Path) -> None:
    name = tmp_path / "c"
    assert main(["board", "7x5", "--square-mm", "20", "--charuco", "DICT_4X4_50", "-o", str(name)]) == 0
    before = load_board(name.with_suffix(".toml"))
    path = str(name.with_suffix(".toml"))
    assert main(["board", path, "--ruler-x-mm", "161.6", "--ruler-y-mm", "121.2"]) == 0
    after = load_board(path)
    assert isinstance(before.pattern, Charuco)
    assert isinstance(after.pattern, Charuco)
    assert after.square_x_mm == pytest.approx(20.2, abs=1e-4)
    assert after.pattern.marker_mm == pytest.approx(1.01 * before.pattern.marker_mm, rel=1e-4)
    assert after.pattern.dictionary == "DICT_4X4_50"


@pytest.mark.parametrize(
    "arguments",
    [
        ["--charuco", "DICT_UNKNOWN"],
        ["--charuco", "DICT_4X4_50", "--first-marker", "40"],
        ["--charuco", "DICT_4X4_50", "--marker-mm", "25"],
        ["--marker-mm", "15"],
        ["--legacy"],
    ],
)
def test_bad_input_is_one_line(arguments: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["board", "7x5", "--square-mm", "20", "-o", str(tmp_path / "c"), *arguments]) == 2
    error = [line for line in capsys.readouterr().err.splitlines() if line.startswith("rigkit:")]
    assert len(error) == 1
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    "line", ["marker_mm = 10.0", 'dictionary = "DICT_5X5_100"', 'dictionary = "DICT_5X5_100"\nmarker_mm = -1.0']
)
def test_a_board_file_with_half_a_charuco_board_is_refused(
    line: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "c.toml"
    path.write_text(f'schema = "rigkit.board/1"\ncolumns = 7\nrows = 5\nsquare_mm = 20.0\n{line}\n')
    assert main(["board", str(path), "-o", str(tmp_path / "c")]) == 2
    assert "rigkit:" in capsys.readouterr().err


def test_from_images_to_a_calibration(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Half of the images show a part of the board only: its numbers keep their places."""
    name = tmp_path / "c9x6"
    assert main(["board", "9x6", "--square-mm", "20", "--charuco", "DICT_5X5_100", "-o", str(name)]) == 0
    board: Board = load_board(name.with_suffix(".toml"))
    folder = tmp_path / "images"
    folder.mkdir()
    for seed in range(6):
        rng = np.random.default_rng(seed)
        scene = one_board(rng, board=board, square_px=34.0, max_tilt_deg=40.0)
        image = scene.render(supersample=2, noise_levels=2.0, rng=rng)
        if seed % 2:
            image[:, : 40 * seed] = 90
        cv2.imwrite(str(folder / f"{seed}.png"), image)
    corners = tmp_path / "corners.csv"
    assert main(["detect", str(folder), "--board", f"{name}.toml", "-o", str(corners), "--jobs", "1"]) == 0
    assert capsys.readouterr().out.count("c9x6 9x6") == 6
    session = tmp_path / "session.toml"
    session.write_text(
        'schema = "rigkit.session/1"\nimages = "images/*.png"\nboard = "c9x6.toml"\n'
        'model = "brown"\nboard_shape = "flat"\n'
    )
    assert main(["calibrate", str(session), "--json"]) == 0
    result = json.loads((tmp_path / "calibration.json").read_text())
    truth = bench_camera("regular").parameters
    focal = np.array([result["camera"]["parameters"][name] for name in ("fx", "fy")])
    assert np.abs(focal / truth[:2] - 1.0).max() < 2e-3
    assert not result["dropped"]
    # With the camera the same images give at least as many corners.
    again = tmp_path / "again.csv"
    camera = ["--camera", str(tmp_path / "calibration.json")]
    assert main(["detect", str(folder), "--board", f"{name}.toml", "-o", str(again), "--jobs", "1", *camera]) == 0
    assert len(again.read_text().splitlines()) > 0.97 * len(corners.read_text().splitlines())
