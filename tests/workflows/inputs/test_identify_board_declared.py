"""What is said where circles are mirrored, or where a board is declared otherwise than it is printed."""

from __future__ import annotations

from dataclasses import replace
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
from rigkit.core.patterns.circles import Circles
from rigkit.workflows.inputs.identify_board import why_not_detected

REGULAR = Board("b", 7, 6, 40.0, 40.0, pattern=Circles(diameter_mm=24.0))
HEXAGONAL = Board("b", 7, 6, 40.0, 40.0, pattern=Circles("hexagonal", diameter_mm=28.0))
ASYMMETRIC = Board("b", 4, 10, 40.0, 40.0, pattern=Circles("asymmetric", diameter_mm=16.0))
ODD = Board("b", 4, 11, 40.0, 40.0, pattern=Circles("asymmetric", diameter_mm=16.0))


def photographs(folder: Path, board: Board, count: int = 1, *, mirrored: bool = False) -> list[Path]:
    """Write rendered images of a board, mirrored left to right if so; return their names."""
    out = []
    for seed in range(count):
        rng = np.random.default_rng(seed)
        picture = one_board(rng, board=board, max_tilt_deg=30.0).render(supersample=2, noise_levels=1.0, rng=rng)
        out.append(folder / f"{seed}.png")
        cv2.imwrite(str(out[-1]), np.asarray(picture, np.uint8)[:, :: -1 if mirrored else 1])
    return out


@pytest.mark.parametrize("board", [HEXAGONAL, ASYMMETRIC], ids=["hexagonal", "asymmetric"])
def test_mirrored_grids_with_staggered_rows_are_named(tmp_path: Path, board: Board) -> None:
    words = why_not_detected(photographs(tmp_path, board, mirrored=True), [board])
    assert words is not None
    assert words.startswith("the images are mirrored: '0.png' shows its board only when it is flipped left to right")
    assert 'if the board itself is printed so, set stagger = "left"; otherwise switch off mirroring' in words


@pytest.mark.parametrize("board", [REGULAR, ODD], ids=["regular", "odd rows"])
def test_grids_that_are_the_same_in_a_mirror_are_found(tmp_path: Path, board: Board) -> None:
    """Mirrored, they are their own copies, turned: no calibration is wrong."""
    assert why_not_detected(photographs(tmp_path, board, mirrored=True), [board]) is None
    assert main(["detect", str(tmp_path), "--board", words_of(board), "-o", str(tmp_path / "corners.csv")]) == 0


def words_of(board: Board) -> str:
    pattern = board.pattern
    assert isinstance(pattern, Circles)
    return f"circles:{board.columns}x{board.rows}x40,layout={pattern.layout},diameter_mm={pattern.diameter_mm}"


def test_an_identified_grid_with_rows_staggered_to_the_left_may_be_mirrored(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    photographs(tmp_path, HEXAGONAL, mirrored=True)
    assert main(["board", "identify", str(tmp_path)]) == 0
    printed = capsys.readouterr()
    assert "layout=hexagonal,stagger=left" in printed.out
    assert "as BoofCV prints them; if the rows of the print begin further right" in printed.err


@pytest.mark.parametrize(
    ("printed", "declared", "told"),
    [
        (REGULAR, replace(REGULAR, columns=6), "7 x 6 circles are seen, 6 x 6 are declared"),
        (REGULAR, replace(REGULAR, pattern=HEXAGONAL.pattern), 'in the images: set layout = "regular"'),
        (HEXAGONAL, replace(HEXAGONAL, pattern=REGULAR.pattern), 'in the images: set layout = "hexagonal"'),
        (ASYMMETRIC, replace(ASYMMETRIC, pattern=REGULAR.pattern), 'in the images: set layout = "asymmetric"'),
        (REGULAR, replace(REGULAR, pattern=Circles(inverted=True)), "in the images: set inverted = false"),
        (HEXAGONAL, replace(HEXAGONAL, rows=8), "7 x 6 circles are seen, 7 x 8 are declared"),
    ],
    ids=["columns", "no hexagonal", "hexagonal", "asymmetric", "inverted", "rows"],
)
def test_grids_unlike_the_declared_ones_are_told_with_the_line_to_change(
    tmp_path: Path, printed: Board, declared: Board, told: str
) -> None:
    words = why_not_detected(photographs(tmp_path, printed, 2), [declared])
    assert words is not None and told in words


@pytest.mark.parametrize(
    ("printed", "declared", "told"),
    [
        (
            Charuco("DICT_4X4_100", 30.0, 60),
            "charuco:7x6x40,dictionary=DICT_4X4_100,marker_mm=30,first_marker=58",
            "first_marker = 60",
        ),
        (AprilGrid(0.3), "aprilgrid:4x3x40,spacing=0.3,first_tag=5", "first_tag = 0"),
    ],
    ids=["ChArUco", "AprilGrid"],
)
def test_a_wrong_first_mark_of_which_half_the_corners_remain_is_told(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], printed: Pattern, declared: str, told: str
) -> None:
    columns, rows = (7, 6) if isinstance(printed, Charuco) else (8, 6)
    photographs(tmp_path, Board("b", columns, rows, 40.0, 40.0, pattern=printed), 3)
    main(["calibrate", str(tmp_path), "--board", declared, "--model", "pinhole", "-o", str(tmp_path / "camera.json")])
    assert f"in the images: set {told}" in "".join(capsys.readouterr())
