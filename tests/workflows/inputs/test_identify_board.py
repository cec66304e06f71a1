"""Notes of `identify_board` besides the identified board."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from detection_bench.scenes import one_board

from rigkit.cli.main import main
from rigkit.core.boards import Board
from rigkit.core.patterns.aprilgrid import AprilGrid
from rigkit.core.patterns.base import Pattern
from rigkit.core.patterns.charuco import Charuco
from rigkit.detection.unknown import BoardGuess
from rigkit.io.boards.board_words import with_length
from rigkit.io.manifests.session import load_session
from rigkit.workflows.inputs import identify_board
from rigkit.workflows.inputs.folder_session import session_of_folders

BLUR_PX, NOISE_LEVELS = 4.0, 10.0
"""Together too much for a board of unknown size, in an image of 320 px."""


@pytest.mark.parametrize("pattern", [AprilGrid(0.3), Charuco("DICT_4X4_50", 30.0)])
def test_two_equal_boards_are_reported(pattern: Pattern, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    board = Board("b", 8, 6, 40.0, 40.0, pattern=pattern)
    picture = one_board(np.random.default_rng(0), board=board, max_tilt_deg=10.0).render(supersample=2)
    for name, image in (("one.png", picture), ("two.png", np.hstack([picture, picture]))):
        path = tmp_path / name
        cv2.imwrite(str(path), np.asarray(image))
        assert main(["board", "identify", str(path)]) == 0
        err = capsys.readouterr().err
        assert ("two boards alike in 1 of 1 images, such as 'two.png'" in err) == (name == "two.png")
        assert ("first_marker, first_tag" in err) == (name == "two.png")


def test_images_that_cannot_be_read_are_not_without_a_board(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    cv2.imwrite(str(tmp_path / "one.tif"), np.zeros((40, 60), np.float32))
    for arguments in (["--square-mm", "40"], []):
        assert main(["calibrate", str(tmp_path), *arguments]) == 2
        assert "float32 pixels; save it with 8 or 16 bits" in capsys.readouterr().err
    cv2.imwrite(str(tmp_path / "one.tif"), np.zeros((1, 1), np.uint8))
    assert main(["calibrate", str(tmp_path), "--square-mm", "40"]) == 2
    assert f"'{tmp_path / 'one.tif'}': image: 1x1 pixels are too few" in capsys.readouterr().err


def mirrored(image: np.ndarray) -> np.ndarray:
    return image[:, ::-1]


@pytest.mark.parametrize(
    "pattern",
    [
        Charuco("DICT_4X4_50", 30.0),
        # Markers this small pass for ink in the squares of a chessboard.
        Charuco("DICT_4X4_50", 18.0),
        AprilGrid(0.3),
    ],
)
def test_marks_in_a_mirror_cannot_be_read(pattern: Pattern, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    board = Board("b", 8, 6, 40.0, 40.0, pattern=pattern)
    for k in range(2):
        picture = np.asarray(one_board(np.random.default_rng(k), board=board, max_tilt_deg=10.0).render(supersample=2))
        cv2.imwrite(str(tmp_path / f"{k}.png"), mirrored(picture))
    assert main(["board", "identify", str(tmp_path)]) == 1
    assert "the images are mirrored: '0.png' shows its board only" in capsys.readouterr().err
    assert main(["calibrate", str(tmp_path), "--square-mm", "40"]) == 2
    assert "calibrate: the images are mirrored: '0.png' shows its board only" in capsys.readouterr().err


def test_negatives_of_tags_are_white_tags(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A board declared black on white is not found, and why is said."""
    board = Board("b", 8, 6, 40.0, 40.0, pattern=AprilGrid(0.3))
    for k in range(2):
        picture = np.asarray(
            one_board(np.random.default_rng(k), board=board, max_tilt_deg=10.0).render(supersample=2), np.uint8
        )
        cv2.imwrite(str(tmp_path / f"{k}.png"), 255 - picture)
    assert main(["board", "identify", str(tmp_path)]) == 0
    assert "--board aprilgrid:4x3xMM,spacing=0.3,inverted=true" in capsys.readouterr().out
    assert main(["calibrate", str(tmp_path), "--board", "aprilgrid:4x3x40,spacing=0.3"]) == 2
    assert "black and white are exchanged: set inverted = true" in capsys.readouterr().err


def test_a_chessboard_in_a_mirror_is_a_chessboard(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    picture = np.asarray(one_board(np.random.default_rng(0), board=Board("b", 8, 6, 40.0, 40.0)).render(supersample=2))
    cv2.imwrite(str(tmp_path / "0.png"), mirrored(picture))
    assert main(["board", "identify", str(tmp_path)]) == 0
    assert "--board 8x6xMM" in capsys.readouterr().out


def test_a_grid_too_blurred_to_be_believed_is_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """With its size given it may be found."""
    scene = one_board(np.random.default_rng(0), board=Board("b", 8, 6, 20.0, 20.0), size_px=(320, 240))
    picture = np.asarray(scene.render(supersample=2), np.float32)
    noise = np.random.default_rng(1).normal(0.0, NOISE_LEVELS, picture.shape)
    worse = np.clip(cv2.GaussianBlur(picture, (0, 0), BLUR_PX) + noise, 0.0, 255.0)
    cv2.imwrite(str(tmp_path / "0.png"), worse.astype(np.uint8))
    assert main(["board", "identify", str(tmp_path)]) == 1
    assert "in '0.png' a 8x6 grid is seen, corners uncertain by" in capsys.readouterr().err
    assert main(["calibrate", str(tmp_path), "--square-mm", "40"]) == 2
    words = capsys.readouterr().err
    assert "no board is seen in the images (in '0.png' a 8x6 grid is seen" in words and "below" not in words


def test_a_folder_below_is_named_where_images_show_nothing(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "calib").mkdir()
    for path in (tmp_path / "0.png", tmp_path / "calib" / "1.png"):
        cv2.imwrite(str(path), np.zeros((40, 40), np.uint8))
    assert main(["calibrate", str(tmp_path), "--square-mm", "40"]) == 2
    assert f"but '{tmp_path / 'calib'}' below has others: give it instead" in capsys.readouterr().err


def test_images_that_do_not_decide_between_two_sizes(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    cv2.imwrite(str(tmp_path / "0.png"), np.zeros((40, 40), np.uint8))
    seen = BoardGuess(board=Board("b", 9, 6, 1.0, 1.0), images=(0,), sizes=((9, 6), (10, 6)))
    monkeypatch.setattr(identify_board, "guess_board", lambda *_: seen)
    assert main(["board", "identify", str(tmp_path)]) == 1
    words = "a chessboard of 9 x 6 or 10 x 6 inner corners and do not tell which; count them on the board"
    assert f"1 image of 1 show {words}" in capsys.readouterr().err
    assert main(["calibrate", str(tmp_path), "--square-mm", "40"]) == 2
    assert f"the images show {words}, and give it as --board" in capsys.readouterr().err


def test_tags_whose_edges_have_moved(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """What is known is said, and what helps."""
    cv2.imwrite(str(tmp_path / "0.png"), np.zeros((40, 40), np.uint8))
    board, either = (
        Board("b", 8, 6, 1.0, 1.0, pattern=AprilGrid(spacing, border=border))
        for spacing, border in ((0.3, 2), (0.625, 1))
    )
    seen = BoardGuess(board=board, images=(0,), edges_moved=True, other_border=either)
    monkeypatch.setattr(identify_board, "guess_board", lambda *_: seen)
    assert main(["board", "identify", str(tmp_path)]) == 1
    err = capsys.readouterr().err
    assert "aprilgrid:4x3xMM,spacing=0.3 or aprilgrid:4x3xMM,spacing=0.625,border=1" in err
    assert "take images with less light" in err
    assert main(["calibrate", str(tmp_path), "--square-mm", "40"]) == 2
    assert "measure a tag and the gap beside it, and give it as --board" in capsys.readouterr().err


def test_rows_of_a_marked_board_that_no_image_shows(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    cv2.imwrite(str(tmp_path / "0.png"), np.zeros((40, 40), np.uint8))
    board = Board("b", 10, 6, 1.0, 1.0, pattern=Charuco("DICT_4X4_50", 0.75))
    seen = BoardGuess(board=board, images=(0,), sizes=(board.size,))
    monkeypatch.setattr(identify_board, "guess_board", lambda *_: seen)
    assert main(["board", "identify", str(tmp_path)]) == 1
    words = "a ChArUco board of at least 10 x 6 inner corners, charuco:10x6xMM,dictionary=DICT_4X4_50"
    assert words in capsys.readouterr().err
    assert main(["calibrate", str(tmp_path), "--square-mm", "40"]) == 2
    assert "count them on the board, and give it as --board" in capsys.readouterr().err


def test_a_folder_of_two_boards(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Half of the images show one, half the other; calibration takes the images of one size that show its board."""
    boards = [Board("a", 8, 6, 40.0, 40.0, pattern=AprilGrid(0.3)), Board("b", 8, 6, 40.0, 40.0)]
    for k in range(4):
        picture = one_board(np.random.default_rng(k), board=boards[k % 2], max_tilt_deg=10.0).render(supersample=2)
        cv2.imwrite(str(tmp_path / f"{k}.png"), np.asarray(picture))
    assert main(["board", "identify", str(tmp_path)]) == 0
    out = capsys.readouterr().out
    assert "seen in 2 of 4 images\n--board aprilgrid:4x3xMM,spacing=0.3" in out
    assert "2 other images, such as '1.png', show another board: --board 8x6xMM" in out


def test_every_second_image_shows_the_board(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Of 24 images every second one is looked at first: those that show nothing."""
    paths = [tmp_path / f"{k:02d}.png" for k in range(24)]
    for k, path in enumerate(paths):
        cv2.imwrite(str(path), np.full((40, 40), 200 * (k % 2), np.uint8))
    seen = BoardGuess(board=Board("b", 9, 6, 1.0, 1.0), images=(0, 1))
    monkeypatch.setattr(
        identify_board, "guess_board", lambda images, *_: seen if any(image.mean() > 0.0 for image in images) else None
    )
    assert identify_board.suggestion(paths).words == "9x6xMM"
    assert identify_board.suggestion(paths[::2]).words is None


@pytest.mark.parametrize("sizes", [(), ((9, 6),)], ids=["whole", "cut"])
def test_another_board_in_the_other_images_is_named_where_its_size_is_known(
    sizes: tuple[tuple[int, int], ...], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    paths = [tmp_path / f"{k}.png" for k in range(4)]
    for k, path in enumerate(paths):
        cv2.imwrite(str(path), np.full((40, 40), 100 * (k % 2), np.uint8))
    first = BoardGuess(board=Board("b", 8, 5, 1.0, 1.0), images=(0, 2))
    other = BoardGuess(board=Board("b", 9, 6, 1.0, 1.0), images=(0, 1), sizes=sizes)
    monkeypatch.setattr(identify_board, "guess_board", lambda images, *_: first if len(images) == 4 else other)
    found = identify_board.identify_board(paths)
    assert found.elsewhere == (None if sizes else ("9x6xMM", ("1.png", "3.png")))


def test_boards_of_one_session_have_no_tag_in_common(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """A second grid of tags is on the rig, or in pictures of something else: then it has tags of the first."""
    cv2.imwrite(str(tmp_path / "0.png"), np.zeros((40, 40), np.uint8))
    first, longer, second = (
        Board("board", *size, 1.0, 1.0, pattern=AprilGrid(0.3, first_tag=tag))
        for size, tag in (((12, 12), 0), ((22, 12), 0), ((12, 12), 36))
    )
    seen = BoardGuess(board=first, images=(0,), beside=(longer, second))
    monkeypatch.setattr(identify_board, "guess_board", lambda *_: seen)
    words = identify_board.suggestion([tmp_path / "0.png"]).words
    assert words == "aprilgrid:6x6xMM,spacing=0.3 --board aprilgrid:6x6xMM,spacing=0.3,first_tag=36"
    declared = with_length(words, 88.0).split(" --board ")
    session = tmp_path / "session.toml"
    for path, text in session_of_folders([tmp_path], declared, session).items():
        path.write_text(text)
    assert [board.pattern for board in load_session(session).boards] == [first.pattern, second.pattern]
