"""Corners files: read back equal, and faults are refused with their line."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from rigkit.core.boards import Board
from rigkit.core.detections import BoardDetection
from rigkit.core.errors import InputError
from rigkit.io.corners.corner_cache import CornerCache, FoundCorners
from rigkit.io.corners.corners_file import COLUMNS, read_corners, write_corners
from rigkit.io.manifests.session import Session, load_session
from rigkit.workflows.inputs.corners import given_corners

WRITTEN_PX = 1e-5
"""Five decimals."""


def detections() -> dict[str, tuple[BoardDetection, ...]]:
    board = Board("a", 4, 3, 30.0, 30.0)
    grid = board.grid()
    pixels = 12.345678 * grid.astype(float) + 100.0
    named = BoardDetection("a", 4, 3, grid, pixels, np.full(12, 0.0123))
    partial = BoardDetection(None, 5, 4, grid[:7], pixels[:7] + 200.0, np.full(7, 0.02))
    return {"one, with comma.png": (named, partial), "two.png": (partial,)}


def session_of(folder: Path, images: str) -> Session:
    """Return a session of a blank picture called 'Bild [4].png'."""
    cv2.imwrite(str(folder / "Bild [4].png"), np.zeros((8, 8), dtype=np.uint8))
    (folder / "board.toml").write_text('schema = "rigkit.board/1"\ncolumns = 4\nrows = 3\nsquare_mm = 30.0\n')
    (folder / "session.toml").write_text(
        f'schema = "rigkit.session/1"\nimages = "{images}"\nboard = "board.toml"\nmodel = "brown"\n'
    )
    return load_session(folder / "session.toml")


@pytest.mark.parametrize("images", ["*.png", "Bild [4].png"])
def test_corners_of_other_images_than_the_session_s_are_refused(tmp_path: Path, images: str) -> None:
    session = session_of(tmp_path, images)
    assert [path.name for path in session.images] == ["Bild [4].png"]
    write_corners(tmp_path / "corners.csv", detections())
    with pytest.raises(InputError, match=r"names none of the 1 images.*here 'one, with comma.png'"):
        given_corners(session, tmp_path / "corners.csv")


def test_round_trip(tmp_path: Path) -> None:
    path = tmp_path / "corners.csv"
    write_corners(path, detections())
    assert path.read_text().splitlines()[0] == ",".join(COLUMNS)
    back = read_corners(path, [Board("a", 4, 3, 30.0, 30.0)])
    assert list(back) == list(detections())
    for image, expected in detections().items():
        for one, two in zip(back[image], expected, strict=True):
            assert (one.board_id, one.columns, one.rows) == (two.board_id, two.columns, two.rows)
            assert np.array_equal(one.grid, two.grid)
            assert np.abs(one.pixels - two.pixels).max() <= WRITTEN_PX
            assert np.abs(one.sigma_px - two.sigma_px).max() <= WRITTEN_PX


def test_existing_file_is_left(tmp_path: Path) -> None:
    path = tmp_path / "corners.csv"
    path.write_text("mine")
    with pytest.raises(InputError, match="--force"):
        write_corners(path, detections())
    assert path.read_text() == "mine"


@pytest.mark.parametrize(
    "text, word",
    [
        ("image,board\n", "first line"),
        (",".join(COLUMNS) + "\na.png,b,0,zero,1,2,0.1\n", "line 2"),
        (",".join(COLUMNS) + "\na.png,b,0,0,1\n", "line 2"),
    ],
)
def test_bad_files_are_refused(text: str, word: str, tmp_path: Path) -> None:
    path = tmp_path / "corners.csv"
    path.write_text(text)
    with pytest.raises(InputError, match=word):
        read_corners(path)


@pytest.mark.parametrize("value", ["nan", "inf", "1e400"])
def test_a_value_that_is_no_place_is_refused_with_its_line(tmp_path: Path, value: str) -> None:
    path = tmp_path / "corners.csv"
    path.write_text(f"{','.join(COLUMNS)}\na.png,a,0,0,1.0,2.0,0.1\na.png,a,1,0,{value},2.0,0.1\n")
    with pytest.raises(InputError, match=r"line 3.*NaN or infinite") as caught:
        read_corners(path)
    assert str(path) in str(caught.value)


def test_corners_that_are_none_of_a_board_name_the_file(tmp_path: Path) -> None:
    path = tmp_path / "corners.csv"
    for sigma, grid in (("-0.1", "1,0"), ("0.1", "-1,0"), ("0.1", "0,0"), ("0.1", f"{10**30},0")):
        path.write_text(f"{','.join(COLUMNS)}\na.png,a,0,0,1.0,2.0,0.1\na.png,a,{grid},5.0,2.0,{sigma}\n")
        with pytest.raises(InputError, match=r"corners\.csv"):
            read_corners(path)


VNL = """## produced by a detector
# filename x y level
a.jpg 10.5 20.25 0
a.jpg 30 20 1
a.jpg - - -
a.jpg 10 40 0
a.jpg 30 40 -
a.jpg 50 40 2
b.jpg - - -
"""


def test_corners_of_other_detectors(tmp_path: Path) -> None:
    """mrgingham's table: corners row by row, each level of the pyramid twice as uncertain."""
    path = tmp_path / "corners.vnl"
    path.write_text(VNL)
    board = Board("a", 3, 2, 30.0, 30.0)
    found = read_corners(path, [board])
    assert list(found) == ["a.jpg", "b.jpg"] and found["b.jpg"] == ()
    (one,) = found["a.jpg"]
    assert one.board_id == "a" and one.grid.tolist() == [[0, 0], [1, 0], [0, 1], [2, 1]]
    assert one.pixels.tolist() == [[10.5, 20.25], [30.0, 20.0], [10.0, 40.0], [50.0, 40.0]]
    assert (one.sigma_px / one.sigma_px[0]).tolist() == [1.0, 2.0, 1.0, 4.0]
    path.write_text(
        VNL.replace(" level", " weight").replace(" 2\n", " 0.25\n").replace("20 1", "20 0.5").replace(" 0\n", " 1\n")
    )
    again = read_corners(path, [board])["a.jpg"][0]
    assert again.sigma_px.tolist() == one.sigma_px.tolist()


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("a.jpg 10 40 0\n", "", "5 lines"),
        ("filename x", "file x", "columns must be"),
        ("30 20 1", "30 x 1", "line 4"),
        ("30 20 1", "30 20 900", "line 4"),
        ("30 20 1", "nan 20 1", "line 4"),
        ("a.jpg 30 20 1", "a.jpg", "line 4"),
    ],
)
def test_damaged_corners_of_other_detectors(tmp_path: Path, old: str, new: str, words: str) -> None:
    path = tmp_path / "corners.vnl"
    path.write_text(VNL.replace(old, new))
    with pytest.raises(InputError, match=words):
        read_corners(path, [Board("a", 3, 2, 30.0, 30.0)])
    with pytest.raises(InputError, match="about one board"):
        read_corners(path)


def test_kept_corners_of_a_calibration(tmp_path: Path) -> None:
    path = tmp_path / "corners.json"
    board = Board("a", 3, 2, 30.0, 30.0)
    detection = BoardDetection("a", 3, 2, board.grid(), np.arange(12.0).reshape(-1, 2), np.full(6, 0.1))
    cache = CornerCache(path, [board])
    cache.put("x.png", "0", FoundCorners((640, 480), (detection,)))
    cache.save()
    (back,) = read_corners(path)["x.png"]
    assert back.pixels.tolist() == detection.pixels.tolist() and back.board_id == "a"
    for old, new in (
        ('"grid": [[', '"grid": [[1e999, '),
        ('"pixels": ', '"pixels": ' + "[" * 9000),
        ("rigkit.corners/2", "x"),
    ):
        text = path.read_text()
        path.with_name("d.json").write_text(text.replace(old, new))
        with pytest.raises(InputError, match=r"d\.json"):
            read_corners(path.with_name("d.json"))


def test_corners_of_an_earlier_detector_go_when_new_ones_come(tmp_path: Path) -> None:
    """Both in one file would be taken for one detector's."""
    cache = CornerCache(tmp_path / "corners.json", [Board("a", 4, 3, 30.0, 30.0)])
    found = FoundCorners((640, 480), detections()["two.png"])
    cache.put("old.png", "0" * 64, found)
    cache.current = False
    assert cache.images == ["old.png"] and cache.get("old.png", "0" * 64) is None
    cache.put("new.png", "1" * 64, found)
    assert cache.images == ["new.png"] and cache.current
