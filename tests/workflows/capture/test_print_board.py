"""Names of the files of `rigkit board`, and boards whose scale no image shows."""

from __future__ import annotations

from pathlib import Path

import pytest

from rigkit.cli.board_identify import without_scale
from rigkit.core.boards import Board
from rigkit.core.errors import InputError
from rigkit.core.patterns.charuco import Charuco
from rigkit.core.patterns.circles import Circles
from rigkit.workflows.capture.print_board import print_board
from rigkit.workflows.options.cameras import PrintOptions


@pytest.mark.parametrize(
    ("given", "stem"), [("a.pdf", "a"), ("a.svg", "a"), ("a.toml", "a"), ("a-25.4", "a-25.4"), ("a", "a")]
)
def test_a_name_with_its_ending_has_it_once(given: str, stem: str, tmp_path: Path) -> None:
    written = print_board(Board("x", 4, 3, 20.0, 20.0), PrintOptions(output=tmp_path / given))
    assert [path.name for path in written] == [f"{stem}.pdf", f"{stem}.svg", f"{stem}.toml"]


def test_squares_in_metres_are_not_printed(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"squares of 0\.025 mm are outside 0\.1 to 5000 mm; write mm"):
        print_board(Board("x", 4, 3, 0.025, 0.025), PrintOptions(output=tmp_path / "x"))
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("board", "printed"),
    [
        (
            Board("c", 7, 6, 1.0, 1.0, pattern=Circles(diameter_mm=0.6)),
            "distance of unknown size, diameter about 0.6 of that",
        ),
        (Board("m", 7, 5, 1.0, 1.0, pattern=Charuco("DICT_5X5_100", 0.74)), "markers about 0.74 of that"),
        (Board("b", 9, 6, 1.0, 1.0), "squares of unknown size"),
    ],
    ids=["circles", "charuco", "chessboard"],
)
def test_no_millimetres_without_a_scale(board: Board, printed: str) -> None:
    words = without_scale(board.describe())
    assert printed in words and "mm" not in words
