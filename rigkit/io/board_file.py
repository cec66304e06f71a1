"""Board files: a board as a person measured it (schema "rigkit.board/1").

::

    schema = "rigkit.board/1"
    type = "chessboard"      # optional: of `rigkit.core.patterns.registry`; by default chessboard, with markers charuco
    columns = 9              # inner corners; of an AprilGrid, tags
    rows = 6
    square_mm = 30.0         # or square_x_mm and square_y_mm; of an AprilGrid tag_mm
    square_sigma_mm = 0.05   # optional: how well it was measured
    id = "a9x6_30"           # optional: by default the file's name
    printed_x_mm = 30.0      # optional, both: squares as laid out for printing, which `rigkit board` notes when the
    printed_y_mm = 30.0      # measured print goes into the file

What else there is depends on the type. A ChArUco board::

    dictionary = "DICT_5X5_100"  # of its markers, by the name in OpenCV
    marker_mm = 22.0             # side of a marker with its black border
    first_marker = 0             # optional: number of the first marker
    legacy_pattern = false       # optional: true for boards drawn by OpenCV before 4.6
    inverted = false             # optional: true where black and white are exchanged

An AprilGrid::

    type = "aprilgrid"
    columns = 6                  # tags
    rows = 6
    tag_mm = 88.0                # side of a tag with its black border; tag_x_mm, tag_y_mm, tag_sigma_mm likewise
    spacing = 0.3                # from tag to tag, in sides of a tag
    family = "tag36h11"          # optional, and so are:
    border = 2                   # modules of the black border: Kalibr's 2, OpenCV's 1
    first_tag = 0
    numbering = "kalibr"         # rows of tags from the bottom; "opencv": from the top
    corner_squares = true        # small black squares between the tags, as Kalibr prints them
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from rigkit.core.boards import Board
from rigkit.core.errors import InputError
from rigkit.core.patterns.base import Key, Pattern, Value
from rigkit.core.patterns.charuco import Charuco
from rigkit.core.patterns.chessboard import Chessboard
from rigkit.core.patterns.registry import PATTERNS, pattern_type
from rigkit.io.foreign_boards import foreign_board
from rigkit.io.json_reader import real, whole
from rigkit.io.toml_reader import TomlTable, read_toml

BOARD_SCHEMA = "rigkit.board/1"
MAX_CORNERS = 1000
"""Along one side: no image resolves more."""
BOTH_PRINTED = "printed_x_mm = 30.0 and printed_y_mm = 30.0"
SQUARES_MM = (0.1, 5000.0)
"""Sizes outside are slips of the unit, 0.03 for 0.03 m."""


def load_board(path: str | Path) -> Board:
    """Return the board that the file describes; its id is the file's name unless it says otherwise.

    Target files of other tools will do: see `rigkit.io.foreign_boards`.

    Raises InputError for a missing file, an unknown or missing key, or a value that makes no board.
    """
    values = foreign_board(path)
    table = read_toml(path, BOARD_SCHEMA) if values is None else TomlTable(values, Path(path))
    board = board_from_table(table, Path(path).stem)
    table.done()
    return board


def load_layout(path: str | Path) -> Board:
    """Return the board of the file as it was laid out for printing: as it is, unless its print was measured since.

    Raises InputError like `load_board`.
    """
    board = load_board(path)
    printed = _printed(read_toml(path, BOARD_SCHEMA)) if foreign_board(path) is None else None
    return board if printed is None else board.with_squares(*printed)


def _printed(table: TomlTable) -> tuple[float, float] | None:
    """Return the sides of the squares as laid out for printing where the file has them."""
    if not (table.has("printed_x_mm") or table.has("printed_y_mm")):
        return None
    return table.number("printed_x_mm", hint=BOTH_PRINTED), table.number("printed_y_mm", hint=BOTH_PRINTED)


def board_from_table(table: TomlTable, default_id: str) -> Board:
    """Return the board that a table of any file describes by the keys above; the caller calls `table.done()`."""
    board_id = table.identifier("id", hint='id = "plane1"') if table.has("id") else default_id
    kind = _type_of(table)
    columns = table.integer("columns", hint=f"columns = 9 ({kind.count_word} along x)", at_least=1)
    rows = table.integer("rows", hint=f"rows = 6 ({kind.count_word} along y)", at_least=1)
    for key, count in (("columns", columns), ("rows", rows)):
        if count > MAX_CORNERS:
            raise table.error(
                f"'{key}' is {count}, more than {MAX_CORNERS}; count the {kind.count_word} along one side"
            )
    word = kind.size_word
    if table.has(f"{word}_x_mm") or table.has(f"{word}_y_mm"):
        both = f"{word}_x_mm = 30.0 and {word}_y_mm = 30.0"
        if table.has(f"{word}_mm"):
            raise table.error(f"'{word}_mm' together with '{word}_x_mm' or '{word}_y_mm'; keep one of the two forms")
        x, y = table.number(f"{word}_x_mm", hint=both), table.number(f"{word}_y_mm", hint=both)
    else:
        x = y = table.number(f"{word}_mm", hint=f"{word}_mm = 30.0 (measured with a ruler over many {word}s)")
    for side in (x, y, *(_printed(table) or ())):
        if not SQUARES_MM[0] <= side <= SQUARES_MM[1]:
            raise table.error(f"{word}s of {side:g} mm are outside {SQUARES_MM[0]:g} to {SQUARES_MM[1]:g} mm; write mm")
    sigma = None
    if table.has(f"{word}_sigma_mm"):
        sigma = table.number(f"{word}_sigma_mm", hint=f"{word}_sigma_mm = 0.05")
    try:
        values = {key.name: _value(table, key) for key in kind.keys if key.required or table.has(key.name)}
        pattern = kind.from_keys(values)
        per = pattern.points_per_count
        board = Board(board_id, per * columns, per * rows, x, y, square_sigma_mm=sigma, pattern=pattern)
        board.ink()
    except InputError as error:
        raise error if str(table.path) in str(error) else table.error(f"{error}; correct the board") from error
    return board


def _type_of(table: TomlTable) -> type[Pattern]:
    if table.has("type"):
        return PATTERNS[table.text("type", hint='type = "chessboard"', choices=tuple(PATTERNS))]
    if table.has("dictionary"):
        return Charuco
    for key in Charuco.keys:
        if table.has(key.name):
            raise table.error(f"'{key.name}' without 'dictionary'; add dictionary = \"DICT_5X5_100\", or remove it")
    return Chessboard


def _value(table: TomlTable, key: Key) -> Value:
    if key.kind is bool:
        return table.boolean(key.name, hint=key.hint)
    if key.kind is int:
        return table.integer(key.name, hint=key.hint)
    if key.kind is float:
        return table.number(key.name, hint=key.hint)
    return table.text(key.name, hint=key.hint)


def board_values(board: Board) -> dict[str, Value]:
    """Return the keys of a board's file, without its name, as another file holds them: exactly, and all of them."""
    pattern, word = board.pattern, board.pattern.size_word
    per = pattern.points_per_count
    values: dict[str, Value] = {"type": pattern.type, "columns": board.columns // per, "rows": board.rows // per}
    values |= {f"{word}_x_mm": board.square_x_mm, f"{word}_y_mm": board.square_y_mm}
    if board.square_sigma_mm is not None:
        values[f"{word}_sigma_mm"] = board.square_sigma_mm
    return {**values, **pattern.key_values()}


def board_of_values(values: Mapping[str, Any], board_id: str) -> Board:
    """Return the board of `board_values`; raises InputError, KeyError, TypeError or ValueError for others."""
    kind = pattern_type(str(values["type"]))
    given = {key.name: values[key.name] for key in kind.keys if key.name in values}
    known = {"type", "columns", "rows", *given, *(f"{kind.size_word}_{end}_mm" for end in ("x", "y", "sigma"))}
    if unknown := sorted(set(values) - known):
        raise InputError(f"a board of type {kind.type} has no {', '.join(unknown)}")
    for key in kind.keys:
        if key.name in given and key.kind is not float and type(given[key.name]) is not key.kind:
            raise TypeError(f"'{key.name}' is {given[key.name]!r}, not {key.kind.__name__}")
        if key.name in given and key.kind is float:
            given[key.name] = real(given[key.name])
    pattern = kind.from_keys(given)
    columns, rows = (pattern.points_per_count * whole(values[name]) for name in ("columns", "rows"))
    x, y = (real(values[f"{kind.size_word}_{axis}_mm"]) for axis in "xy")
    sigma = values.get(f"{kind.size_word}_sigma_mm")
    return Board(board_id, columns, rows, x, y, square_sigma_mm=None if sigma is None else real(sigma), pattern=pattern)


def board_text(board: Board, comment: str, path: Path, *, layout: Board | None = None) -> str:
    """Return the board's file for `path`; with the `layout` that was printed where the squares are measured ones."""
    pattern = board.pattern
    word, per = pattern.size_word, pattern.points_per_count
    lines = [f"# {comment}", f'schema = "{BOARD_SCHEMA}"']
    lines += [] if isinstance(pattern, Chessboard) else [f'type = "{pattern.type}"']
    lines += [f"columns = {board.columns // per}", f"rows = {board.rows // per}"]
    if board.board_id != path.stem:
        lines.append(f"id = {_written(board.board_id)}")
    lines += [f"{word}_x_mm = {board.square_x_mm:.6g}", f"{word}_y_mm = {board.square_y_mm:.6g}"]
    if layout is not None:
        lines += [f"printed_x_mm = {layout.square_x_mm:.6g}", f"printed_y_mm = {layout.square_y_mm:.6g}"]
    if board.square_sigma_mm is not None:
        lines.append(f"{word}_sigma_mm = {board.square_sigma_mm:.4g}")
    lines += [f"{name} = {_written(value)}" for name, value in pattern.key_values().items()]
    return "\n".join(lines) + "\n"


def _written(value: Value) -> str:
    return f"{value:.6g}" if isinstance(value, float) else json.dumps(value, ensure_ascii=False)
