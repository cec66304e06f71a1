"""`rigkit board`: a board to print true to scale, and the size of the measured print in the board's file."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

from rigkit.core.boards import Board
from rigkit.core.errors import InputError
from rigkit.core.printing import brief
from rigkit.io.boards.board_file import board_text, load_layout, wrong_unit
from rigkit.io.disk.reading import about
from rigkit.io.disk.writing import write_atomic, write_together
from rigkit.report.pictures.board_sheet import board_sheet, pdf_bytes, svg_text
from rigkit.workflows.options.cameras import PrintOptions

MAX_SCALE_RATIO = 1.05
"""Maximum ratio of the scales along and across a sheet: printers differ by a per cent, misread rulers by more."""
MAX_STRETCH = 2.0
"""Maximum scale of a print, and its inverse: larger ones are misread rulers."""
ENDINGS = (".pdf", ".svg", ".toml")
"""Endings of written files, which are removed from a given name."""


@dataclass(frozen=True, slots=True, kw_only=True)
class MeasuredPrint:
    """Measured lengths of the two printed rulers."""

    ruler_x_mm: float
    """Length of the lower ruler."""
    ruler_y_mm: float
    """Length of the right ruler."""
    sigma_mm: float | None = None
    """Standard deviation of the readings."""
    paper: str = "a4"
    """Paper of the print, which determines the nominal lengths of the rulers."""

    __repr__ = brief


def print_board(board: Board | str | Path, options: PrintOptions) -> tuple[Path, ...]:
    """Write a board as PDF and SVG, and a new board also as a board file; return the written files.

    The board of a file is printed with its original layout, even if a print was measured since.

    Raises InputError for a board that does not fit on the paper, squares that are not in mm, or a file that cannot be
    written.
    """
    layout = board if isinstance(board, Board) else load_layout(board)
    if wrong := wrong_unit(layout.pattern.size_word, layout.squares_mm):
        raise InputError(f"board: {wrong}")
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
    """Write the square size of a measured print into the board's file; return the updated board.

    Raises InputError for implausible readings, or a file that cannot be written.
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
    if not 1.0 / MAX_SCALE_RATIO < stretch_x / stretch_y < MAX_SCALE_RATIO:
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
