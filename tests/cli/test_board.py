"""`rigkit board`: sheets to print, and the measured print in the board's file."""

from __future__ import annotations

from pathlib import Path

import pytest

from rigkit.cli import board as cli_board
from rigkit.cli.main import main
from rigkit.io.boards.board_file import load_board
from rigkit.io.boards.board_words import board_of_words
from rigkit.workflows.inputs.identify_board import IdentifiedBoard

READ = ["--ruler-x-mm", "249", "--ruler-y-mm", "169.49"]
"""Of rulers of 250 and 170 mm."""


@pytest.fixture
def board(tmp_path: Path) -> Path:
    assert main(["board", "9x6", "--square-mm", "25", "-o", str(tmp_path / "b")]) == 0
    return tmp_path / "b.toml"


def test_measuring_the_same_print_again_changes_nothing(board: Path) -> None:
    for _ in range(3):
        assert main(["board", str(board), *READ, "--sigma-mm", "0.5"]) == 0
        found = load_board(board)
        assert (found.square_x_mm, found.square_y_mm) == pytest.approx((24.9, 24.925), abs=1e-9)
        assert found.square_sigma_mm == pytest.approx(25.0 * 0.5 / 170.0, rel=1e-3)
    # A reading is corrected, not multiplied.
    assert main(["board", str(board), "--ruler-x-mm", "250", "--ruler-y-mm", "170"]) == 0
    assert load_board(board).square_x_mm == load_board(board).square_y_mm == 25.0


def test_another_print_of_a_measured_board_is_the_same_sheet(board: Path) -> None:
    assert main(["board", str(board), *READ]) == 0
    assert main(["board", str(board), "-o", str(board.with_name("again"))]) == 0
    before, again = (board.with_name(name).read_text(encoding="utf-8") for name in ("b.svg", "again.svg"))
    assert before == again


def test_an_undetermined_charuco_pattern_is_reported(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "a.png").touch()
    board = board_of_words("charuco:9x6x30,dictionary=DICT_5X5_250,marker_mm=22")
    seen = IdentifiedBoard(board=board, seen=("a",), looked_at=("a",), words="charuco", either_pattern=True)
    monkeypatch.setattr("rigkit.workflows.inputs.identify_board.identify_board", lambda *_, **__: seen)
    assert main(["board", "identify", str(tmp_path)]) == 0
    assert "set legacy_pattern by its version" in capsys.readouterr().err


def test_a_board_keeps_its_name(board: Path) -> None:
    name = "wall-2.b"
    board.write_text(board.read_text() + f'id = "{name}"\n', encoding="utf-8")
    assert main(["board", str(board), *READ]) == 0
    assert load_board(board).board_id == name


@pytest.mark.parametrize(
    ("options", "printed"),
    [
        (["--ruler-x-mm", "249"], "both --ruler-x-mm and --ruler-y-mm"),
        (["--ruler-x-mm", "24.9", "--ruler-y-mm", "16.9"], "cannot measure"),
        (["--ruler-x-mm", "249", "--ruler-y-mm", "159"], "check the readings"),
    ],
)
def test_misread_measurements_are_refused(
    board: Path, options: list[str], printed: str, capsys: pytest.CaptureFixture[str]
) -> None:
    before = board.read_bytes()
    assert main(["board", str(board), *options]) == 2
    assert printed in capsys.readouterr().err
    assert board.read_bytes() == before


@pytest.mark.parametrize("keys", ["printed_x_mm = 25\n", "printed_x_mm = 25\nprinted_y_mm = 0.02\n"])
def test_half_a_layout_is_refused(board: Path, keys: str, capsys: pytest.CaptureFixture[str]) -> None:
    board.write_text(board.read_text() + keys)
    assert main(["board", str(board), *READ]) == 2
    assert "b.toml" in capsys.readouterr().err


def test_what_help_shows_fits_on_its_paper(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    lines = [line.split("   ")[0].split() for line in (cli_board.__doc__ or "").splitlines() if " -o " in line]
    assert len(lines) == 3
    for _, *words in lines:
        assert main(words) == 0
