"""Board files of every type, boards in words, and target files of other tools."""

from __future__ import annotations

from pathlib import Path

import pytest

from rigkit.core.boards import Board
from rigkit.core.errors import InputError
from rigkit.core.patterns.aprilgrid import AprilGrid
from rigkit.core.patterns.base import Pattern
from rigkit.core.patterns.charuco import Charuco
from rigkit.core.patterns.chessboard import Chessboard
from rigkit.core.patterns.circles import Circles
from rigkit.io.boards.board_file import board_text, load_board
from rigkit.io.boards.board_words import board_in_words, board_of_words

PATTERNS = [
    Chessboard(),
    Charuco("DICT_4X4_100", 20.0, 3, legacy=True, inverted=True),
    AprilGrid(0.25, "tag25h9", 1, 2, "opencv", corner_squares=False, inverted=True),
    Circles("asymmetric", "left", 12.0),
    Circles(diameter_mm=12.0),
]


@pytest.mark.parametrize("pattern", PATTERNS, ids=lambda p: p.type)
def test_a_board_comes_back_from_its_file(pattern: Chessboard, tmp_path: Path) -> None:
    path = tmp_path / "b.toml"
    before = Board("b", 8, 6, 30.0, 30.5, square_sigma_mm=0.02, pattern=pattern)
    path.write_text(board_text(before, "made up", path))
    after = load_board(path)
    assert (after.size, after.squares_mm, after.square_sigma_mm) == (before.size, before.squares_mm, 0.02)
    assert after.pattern == before.pattern


def test_boards_in_words() -> None:
    board = board_in_words("aprilgrid:6x5x88,spacing=0.3,numbering=opencv,corner_squares=false")
    assert board is not None
    assert board.size == (12, 10)
    assert board.pattern == AprilGrid(0.3, numbering="opencv", corner_squares=False)
    plain = board_in_words("9x6x25")
    assert plain is not None
    assert (plain.size, plain.square_x_mm) == ((9, 6), 25.0)
    for as_people_say in ("9x6, 25 mm", "9x6x25mm", "9x6,25"):
        printed = board_in_words(as_people_say)
        assert printed is not None
        assert (printed.board_id, printed.size, printed.square_x_mm) == (plain.board_id, plain.size, 25.0)
    assert board_in_words("board.toml") is None
    with pytest.raises(InputError, match="say how large a square is as well: 9x6x25"):
        board_of_words("9x6")
    for words in (
        "aprilgrid:6x6x88",
        "aprilgrid:6x6",
        "charuco:6x6x88,marker_mm=b",
        "aprilgrid:6x6x88,spacing=0.3,gap=1",
    ):
        with pytest.raises(InputError, match=words.partition(",")[0]):
            board_in_words(words)
    with pytest.raises(InputError, match=r"'dictionary' and 'marker_mm' are missing.* ") as lacking:
        board_in_words("charuco:6x4x30")
    assert board_in_words(str(lacking.value).rpartition(" ")[2]) is not None


KALIBR = "target_type: 'aprilgrid'\ntagCols: 6\ntagRows: 5\ntagSize: 0.088\ntagSpacing: 0.3\n"
CHECKERS = "target_type: checkerboard\ntargetCols: 7\ntargetRows: 6\nrowSpacingMeters: 0.05\ncolSpacingMeters: 0.06\n"
DOTS = "target_type: circlegrid\ntargetCols: 7\ntargetRows: 6\nspacingMeters: 0.02\nasymmetricGrid: False\n"
BOOFCV = "boofcv.alg.fiducial.calib.ConfigCalibrationTarget:\n  grid: {numRows: 7, numCols: 5, shapeSize: 30.0}\n"
HEXAGONAL = (
    "boofcv.alg.fiducial.calib.ConfigCalibrationTarget:\n  type: CIRCLE_HEXAGONAL\n"
    "  grid: {numRows: 24, numCols: 28, shapeSize: 1.0, shapeDistance: 1.2}\n"
)
CALISCOPE = (
    'columns = 4\nrows = 5\nboard_height = 11.0\nboard_width = 8.5\ndictionary = "DICT_4X4_50"\nunits = "inch"\n'
    "aruco_scale = 0.75\nsquare_size_override_cm = 5.4\ninverted = true\n"
)
OPENCV = (
    "<?xml version='1.0'?><opencv_storage><Settings><BoardSize_Width>9</BoardSize_Width>"
    "<BoardSize_Height>6</BoardSize_Height><Square_Size>50</Square_Size>"
    '<Calibrate_Pattern>"CHESSBOARD"</Calibrate_Pattern></Settings></opencv_storage>'
)
OPENCV_YAML = (
    "%YAML:1.0\n---\nSettings:\n   BoardSize_Width: 9\n   BoardSize_Height: 6\n   Square_Size: 5.e+01\n"
    '   Calibrate_Pattern: "CHARUCOBOARD"\n   ArUco_Dict_Name: DICT_4X4_50\n   Marker_Size: 25\n'
)


@pytest.mark.parametrize(
    ("name", "text", "size", "squares", "pattern"),
    [
        ("target.yaml", KALIBR, (12, 10), (88.0, 88.0), AprilGrid(0.3)),
        ("offset.yaml", KALIBR + "codeOffset: 7\n", (12, 10), (88.0, 88.0), AprilGrid(0.3, first_tag=7)),
        ("regular.yaml", DOTS, (7, 6), (20.0, 20.0), Circles()),
        ("quoted.yaml", DOTS.replace("False", '"False"'), (7, 6), (20.0, 20.0), Circles()),
        ("asymmetric.yaml", DOTS.replace("False", "'True'"), (7, 6), (40.0, 40.0), Circles("asymmetric")),
        ("checkers.yaml", CHECKERS, (7, 6), (60.0, 50.0), Chessboard()),
        ("calibration_target.yaml", BOOFCV, (4, 6), (30.0, 30.0), Chessboard()),
        ("hexagonal.yaml", HEXAGONAL, (14, 24), (1.2, 1.2), Circles("hexagonal", "left", 1.0)),
        ("charuco.toml", CALISCOPE, (3, 4), (54.0, 54.0), Charuco("DICT_4X4_50", 40.5, inverted=True)),
        ("settings.xml", OPENCV, (9, 6), (50.0, 50.0), Chessboard()),
        ("settings.yml", OPENCV_YAML, (8, 5), (50.0, 50.0), Charuco("DICT_4X4_50", 25.0)),
    ],
)
def test_target_files_of_other_tools(
    name: str, text: str, size: tuple[int, int], squares: tuple[float, float], pattern: Pattern, tmp_path: Path
) -> None:
    path = tmp_path / name
    path.write_text(text)
    board = load_board(path)
    assert board.size == size
    assert board.squares_mm == pytest.approx(squares)
    assert board.pattern == pattern


def test_keys_of_other_tools_that_are_not_used_are_named(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    path = tmp_path / "target.yaml"
    path.write_text(KALIBR)
    load_board(path)
    assert not caplog.messages
    path.write_text(KALIBR + 'tagFamily: 16h5\n5: 1\n"\\uD800": 1\n')
    load_board(path)
    (words,) = caplog.messages
    assert "not used: tagFamily, 5, \\ud800;" in words


def test_other_files_are_refused(tmp_path: Path) -> None:
    for name, text in (
        ("a.yaml", "cam0: {}\n"),
        ("b.yaml", "target_type: aprilgrid\n"),
        ("neither.yaml", DOTS.replace("False", "maybe")),
        ("odd.yaml", HEXAGONAL.replace("28", "27")),
        ("c.xml", "<a>1</a>"),
    ):
        (tmp_path / name).write_text(text)
        with pytest.raises(InputError, match=name):
            load_board(tmp_path / name)


@pytest.mark.parametrize(
    ("name", "text", "kind"),
    [
        ("circles.yaml", HEXAGONAL.replace("28", "27"), "27 columns, whose rows have 14 and 13 circles in turn"),
        ("squares.yaml", HEXAGONAL.replace("CIRCLE_HEXAGONAL", "SQUARE_GRID"), "type SQUARE_GRID"),
        ("settings.xml", OPENCV.replace("CHESSBOARD", "RADON"), "Calibrate_Pattern RADON"),
    ],
)
def test_targets_of_other_tools_that_rigkit_lacks_are_named(name: str, text: str, kind: str, tmp_path: Path) -> None:
    (tmp_path / name).write_text(text)
    with pytest.raises(InputError, match=f"{name}': {kind}: rigkit has no such target"):
        load_board(tmp_path / name)
