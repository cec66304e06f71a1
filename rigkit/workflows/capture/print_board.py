"""A board to print, true to scale, and its measured print back into the board's file."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

from rigkit.core.boards import Board
from rigkit.core.errors import InputError
from rigkit.core.printing import brief
from rigkit.io.boards.board_file import board_text, load_layout
from rigkit.io.disk.reading import about
from rigkit.io.disk.writing import write_atomic, write_together
from rigkit.report.pictures.board_sheet import board_sheet, pdf_bytes, svg_text
from rigkit.workflows.inputs.paths import NamesFiles

MAX_UNEVEN = 1.05
"""Ratio of the stretches along and across a sheet: printers are a per cent apart, misread rulers more."""
MAX_STRETCH = 2.0
"""Of a ruler: nobody prints so far from the true scale and wants it kept."""
ENDINGS = (".pdf", ".svg", ".toml")
"""Of what is written; a name that is given with one of them is meant without it, "board-25.4" is one as it is."""


@dataclass(frozen=True, slots=True, kw_only=True)
class PrintOptions(NamesFiles):
    """Where a board to print goes."""

    output: Path
    """Name of the files, which get the endings .pdf, .svg and, of a new board, .toml, once."""
    paper: str = "a4"
    """a4, a3, a2, a1, a0, letter or tabloid."""
    force: bool = False
    """Replace files that exist; a board that was read is never replaced."""


@dataclass(frozen=True, slots=True, kw_only=True)
class MeasuredPrint:
    """What a rule shows on the two rulers of a print."""

    ruler_x_mm: float
    """Length of the lower ruler."""
    ruler_y_mm: float
    """Length of the right ruler."""
    sigma_mm: float | None = None
    """How well the rule could be read."""
    paper: str = "a4"
    """What it was printed on, which decides how long the rulers are."""

    __repr__ = brief


def print_board(board: Board | str | Path, options: PrintOptions) -> tuple[Path, ...]:
    """Write a board as PDF and SVG, with its file beside them where it is a new one; return what was written.

    A board's file is printed as it was laid out first, whatever was measured of a print since.

    Raises InputError for a board that does not fit on the paper, or a file that cannot be written.
    """
    layout = board if isinstance(board, Board) else load_layout(board)
    with about(layout.describe().split(", ")[0] if isinstance(board, Board) else board):
        sheet = board_sheet(layout, options.paper)
    name = options.output.with_suffix("") if options.output.suffix in ENDINGS else options.output
    files: dict[Path, str | bytes] = {Path(f"{name}.pdf"): pdf_bytes(sheet), Path(f"{name}.svg"): svg_text(sheet)}
    if isinstance(board, Board):
        own = Path(f"{name}.toml")
        words = "nominal: print, measure both rulers, run rigkit board again"
        files[own] = board_text(replace(layout, board_id=own.stem), words, own)
    write_together(files, force=options.force)
    return tuple(files)


def store_measured_print(path: str | Path, measured: MeasuredPrint) -> Board:
    """Write the size that squares have on a print into the board's file; return the board as it is now.

    Raises InputError for readings that no print has, or a file that cannot be written.
    """
    board = load_layout(path)
    sheet = board_sheet(board, measured.paper)
    readings = ((measured.ruler_x_mm, sheet.ruler_x_mm), (measured.ruler_y_mm, sheet.ruler_y_mm))
    for read, nominal in readings:
        if not 1.0 / MAX_STRETCH < read / nominal < MAX_STRETCH:
            raise InputError(f"board: a ruler of {nominal:g} mm cannot measure {read:g} mm; check the reading")
    stretch_x, stretch_y = (read / nominal for read, nominal in readings)
    words = (
        f"rulers of {sheet.ruler_x_mm:g} and {sheet.ruler_y_mm:g} mm {{}} {measured.ruler_x_mm:g} and "
        f"{measured.ruler_y_mm:g}"
    )
    if not 1.0 / MAX_UNEVEN < stretch_x / stretch_y < MAX_UNEVEN:
        raise InputError(
            f"board: {words.format('that read')}: no printer stretches its two directions so differently; check the "
            "readings"
        )
    sigma = None
    if measured.sigma_mm is not None:
        sigma = measured.sigma_mm * max(board.square_x_mm / sheet.ruler_x_mm, board.square_y_mm / sheet.ruler_y_mm)
    printed = board.with_squares(board.square_x_mm * stretch_x, board.square_y_mm * stretch_y)
    printed = replace(printed, square_sigma_mm=sigma)
    text = board_text(printed, f"measured: {words.format('read')}", Path(path), layout=board)
    write_atomic(path, text, force=True)
    return printed
