"""Board files: a chessboard as a person measured it (schema "rigkit.board/1").

::

    schema = "rigkit.board/1"
    columns = 9              # inner corners
    rows = 6
    square_mm = 30.0         # or square_x_mm and square_y_mm
    square_sigma_mm = 0.05   # optional: how well it was measured
    id = "a9x6_30"           # optional: by default the file's name
    printed_x_mm = 30.0      # optional, both: squares as laid out for printing, which `rigkit board` notes when the
    printed_y_mm = 30.0      # measured print goes into the file

A ChArUco board has four keys more; without them it is read as a chessboard::

    dictionary = "DICT_5X5_100"  # of its markers, by the name in OpenCV
    marker_mm = 22.0             # side of a marker with its black border
    first_marker = 0             # optional: number of the first marker
    legacy_pattern = false       # optional: true for boards drawn by OpenCV before 4.6
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from rigkit.core.boards import Board, Markers, marker_rectangles
from rigkit.core.errors import InputError
from rigkit.io.toml_reader import TomlTable, read_toml

__all__ = ["BOARD_SCHEMA", "board_from_table", "load_board", "load_layout", "with_squares"]

BOARD_SCHEMA = "rigkit.board/1"
MOST_CORNERS = 1000
"""Along one side: no image resolves more."""
BOTH_PRINTED = "printed_x_mm = 30.0 and printed_y_mm = 30.0"
SQUARES_MM = (0.1, 5000.0)
"""Sizes outside are slips of the unit, 0.03 for 0.03 m."""


def load_board(path: str | Path) -> Board:
    """Return the board that the file describes; its id is the file's name unless it says otherwise.

    Raises InputError for a missing file, an unknown or missing key, or a value that makes no board.
    """
    table = read_toml(path, BOARD_SCHEMA)
    board = board_from_table(table, Path(path).stem)
    table.done()
    return board


def load_layout(path: str | Path) -> Board:
    """Return the board of the file as it was laid out for printing: as it is, unless its print was measured since.

    Raises InputError like `load_board`.
    """
    board, printed = load_board(path), _printed(read_toml(path, BOARD_SCHEMA))
    return board if printed is None else with_squares(board, *printed)


def with_squares(board: Board, x_mm: float, y_mm: float) -> Board:
    """Return the board with squares of another size, and markers that grew with them."""
    markers = board.markers
    if markers is not None:
        growth = (x_mm / board.square_x_mm + y_mm / board.square_y_mm) / 2.0
        markers = replace(markers, side_mm=markers.side_mm * growth)
    return replace(board, square_x_mm=x_mm, square_y_mm=y_mm, markers=markers)


def _printed(table: TomlTable) -> tuple[float, float] | None:
    """Return the sides of the squares as laid out for printing where the file has them."""
    if not (table.has("printed_x_mm") or table.has("printed_y_mm")):
        return None
    return table.number("printed_x_mm", hint=BOTH_PRINTED), table.number("printed_y_mm", hint=BOTH_PRINTED)


def board_from_table(table: TomlTable, default_id: str) -> Board:
    """Return the board that a table of any file describes by the keys above; the caller calls `table.done()`."""
    board_id = table.identifier("id", hint='id = "plane1"') if table.has("id") else default_id
    columns = table.integer("columns", hint="columns = 9 (inner corners along x)", at_least=2)
    rows = table.integer("rows", hint="rows = 6 (inner corners along y)", at_least=2)
    for key, count in (("columns", columns), ("rows", rows)):
        if count > MOST_CORNERS:
            raise table.error(f"'{key}' is {count}, more than {MOST_CORNERS}; count the inner corners along one side")
    both = "square_x_mm = 30.0 and square_y_mm = 30.0"
    if table.has("square_x_mm") or table.has("square_y_mm"):
        if table.has("square_mm"):
            raise table.error("'square_mm' together with 'square_x_mm' or 'square_y_mm'; keep one of the two forms")
        x, y = table.number("square_x_mm", hint=both), table.number("square_y_mm", hint=both)
    else:
        x = y = table.number("square_mm", hint="square_mm = 30.0 (measured with a ruler over many squares)")
    for side in (x, y, *(_printed(table) or ())):
        if not SQUARES_MM[0] <= side <= SQUARES_MM[1]:
            raise table.error(f"squares of {side:g} mm are outside {SQUARES_MM[0]:g} to {SQUARES_MM[1]:g} mm; write mm")
    sigma = None
    if table.has("square_sigma_mm"):
        sigma = table.number("square_sigma_mm", hint="square_sigma_mm = 0.05")
    try:
        board = Board(board_id, columns, rows, x, y, square_sigma_mm=sigma, markers=_markers(table))
        marker_rectangles(board)
    except InputError as error:
        raise error if str(table.path) in str(error) else table.error(f"{error}; correct the board") from error
    return board


def _markers(table: TomlTable) -> Markers | None:
    if not table.has("dictionary"):
        for key in ("marker_mm", "first_marker", "legacy_pattern"):
            if table.has(key):
                raise table.error(f"'{key}' without 'dictionary'; add dictionary = \"DICT_5X5_100\", or remove it")
        return None
    dictionary = table.text("dictionary", hint='dictionary = "DICT_5X5_100"')
    side = table.number("marker_mm", hint="marker_mm = 22.0 (with the black border)")
    first = table.integer("first_marker", hint="first_marker = 0", at_least=0) if table.has("first_marker") else 0
    legacy = table.boolean("legacy_pattern", hint="legacy_pattern = false") if table.has("legacy_pattern") else False
    return Markers(dictionary, side, first, legacy)
