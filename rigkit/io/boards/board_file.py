"""Board files: a board as a person measured it (schema "rigkit.board/1").

::

    schema = "rigkit.board/1"
    type = "charuco"             # of `rigkit.core.patterns.registry`; by default chessboard, with a dictionary charuco
    columns = 9                  # inner corners; of an AprilGrid, tags
    rows = 6
    square_mm = 30.0             # or square_x_mm and square_y_mm; of an AprilGrid tag_mm
    dictionary = "DICT_5X5_100"  # further keys are those of the type
    marker_mm = 22.0

`BOARD_KEYS` has every key with its meaning, and `rigkit schema board --keys` prints them.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from rigkit.core.boards import Board
from rigkit.core.patterns.base import Pattern, Value
from rigkit.core.patterns.charuco import Charuco
from rigkit.core.patterns.chessboard import Chessboard
from rigkit.core.patterns.registry import PATTERNS
from rigkit.io.boards.foreign_boards import foreign_board
from rigkit.io.disk.schema_builders import (
    COUNT,
    NAME,
    PLAIN_KINDS,
    POSITIVE,
    Schema,
    choice,
    described,
    file,
    obj,
    optional,
)
from rigkit.io.disk.toml_reader import TomlTable, read_toml, toml_text

BOARD_SCHEMA = "rigkit.board/1"
MAX_CORNERS = 1000
"""Corners along one side: no image resolves more."""
PRINTED = ("printed_x_mm", "printed_y_mm")
SQUARES_MM = (0.1, 5000.0)
"""Sizes outside of this range have the wrong unit, such as 0.03 for 0.03 m."""


def _pattern_keys() -> dict[str, Schema]:
    """Return the keys of all patterns with their hints."""
    out: dict[str, Schema] = {}
    for name, pattern in PATTERNS.items():
        for key in pattern.keys:
            kind = POSITIVE if key.kind is float else PLAIN_KINDS[key.kind]
            known = out.get(key.name, {}).get("description", "")
            out[key.name] = described(kind, f"{known}{'; ' if known else ''}{name}: {key.hint}")
    return out


def _sizes() -> dict[str, Schema]:
    what = {"square": "side of a square", "tag": "AprilGrid: side of a tag with its border"}
    out: dict[str, Schema] = {}
    for word in dict.fromkeys(pattern.size_word for pattern in PATTERNS.values()):
        side = what.get(word, f"{word} between the centres of two circles")
        out[f"{word}_mm?"] = described(POSITIVE, f"{side}, as measured over many of them", 30.0)
        out[f"{word}_x_mm?"] = described(POSITIVE, f"{side} along x, where the two differ", 30.0)
        out[f"{word}_y_mm?"] = described(POSITIVE, f"{side} along y", 30.0)
        out[f"{word}_sigma_mm?"] = described(POSITIVE, "how well it was measured: goes into every length", 0.05)
    return out


BOARD_KEYS: Mapping[str, Schema] = {
    "type?": described(choice(*PATTERNS), "what is printed; by default chessboard, with a dictionary charuco"),
    "columns": described(COUNT, "inner corners along x; of an AprilGrid tags, of a circle grid circles", 9),
    "rows": described(COUNT, "the same along y", 6),
    **_sizes(),
    "printed_x_mm?": described(
        POSITIVE, "squares as laid out for printing, which rigkit board notes; with printed_y_mm", 30.0
    ),
    "printed_y_mm?": described(POSITIVE, "the same along y", 30.0),
    **optional(_pattern_keys()),
}
BOARD_FILE = file(
    BOARD_SCHEMA,
    "A board as a person measured it",
    {"id?": described(NAME, "its name; by default the file's"), **BOARD_KEYS},
)
DECLARED_BOARD = obj(BOARD_KEYS, "the board as declared, by the keys of board files")


def load_board(path: str | Path) -> Board:
    """Return the board of a board file, or of another tool's target file (see `rigkit.io.boards.foreign_boards`).

    Its id is the file's name unless the file states one. Raises InputError for a missing file, an unknown or missing
    key, or an invalid value.
    """
    return measured_board(_table_of(path), Path(path).stem)


def load_layout(path: str | Path) -> Board:
    """Return the board of a file with the square size of its printing layout, before the print was measured.

    Raises InputError as `load_board`.
    """
    table = _table_of(path)
    board = measured_board(table, Path(path).stem)
    return board.with_squares(*(table[key] for key in PRINTED)) if PRINTED[0] in table else board


def _table_of(path: str | Path) -> TomlTable:
    foreign = foreign_board(path)
    return read_toml(path, BOARD_FILE) if foreign is None else TomlTable(foreign, DECLARED_BOARD, Path(path))


def measured_board(table: TomlTable, default_id: str) -> Board:
    """Return the board of a table that a person wrote, as `board_from_table`.

    Raises InputError also for implausible sizes, and a pattern that cannot be printed.
    """
    board = board_from_table(table, default_id)
    word, per = board.pattern.size_word, board.pattern.points_per_count
    for key, count in (("columns", board.columns // per), ("rows", board.rows // per)):
        if count > MAX_CORNERS:
            words = board.pattern.count_word
            raise table.error(f"'{key}' is {count}, more than {MAX_CORNERS}; count the {words} along one side")
    sides = (*board.squares_mm, *(table[key] for key in PRINTED if any(key in table for key in PRINTED)))
    if wrong := wrong_unit(word, sides):
        raise table.error(wrong)
    with table.located("; correct the board"):
        board.ink()
    return board


def wrong_unit(word: str, sides_mm: Iterable[float]) -> str | None:
    """Return in words which of the sides of squares (or of what `word` calls them) is no length in mm; None if all
    may be."""
    wrong = next((side for side in sides_mm if not SQUARES_MM[0] <= side <= SQUARES_MM[1]), None)
    if wrong is None:
        return None
    return f"{word}s of {wrong:g} mm are outside {SQUARES_MM[0]:g} to {SQUARES_MM[1]:g} mm; write mm"


def board_from_table(table: TomlTable, default_id: str) -> Board:
    """Return the board of a table with BOARD_KEYS, such as `board_values` writes."""
    kind = _type_of(table)
    word = kind.size_word
    sizes = [f"{word}{end}_mm" for end in ("", "_x", "_y", "_sigma")]
    table.allow_only(["schema", "id", "type", "columns", "rows", *PRINTED, *sizes, *(key.name for key in kind.keys)])
    columns, rows = table["columns"], table["rows"]
    if sizes[0] in table and (sizes[1] in table or sizes[2] in table):
        raise table.error(f"'{word}_mm' together with '{word}_x_mm' or '{word}_y_mm'; keep one of the two forms")
    x, y = (table[key] for key in (sizes[1:3] if sizes[1] in table or sizes[2] in table else (sizes[0],) * 2))
    for key in kind.keys:
        if key.required and key.name not in table:
            raise table.error(f"'{key.name}' is missing; add {key.hint}")
    with table.located("; correct the board"):
        pattern = kind.from_keys({key.name: table[key.name] for key in kind.keys if key.name in table})
        per, sigma = pattern.points_per_count, table.get(sizes[3])
        name = table.get("id", default_id)
        return Board(name, per * columns, per * rows, x, y, square_sigma_mm=sigma, pattern=pattern)


def _type_of(table: TomlTable) -> type[Pattern]:
    if "type" in table:
        return PATTERNS[table["type"]]
    if "dictionary" in table:
        return Charuco
    for key in Charuco.keys:
        if key.name in table:
            raise table.error(f"'{key.name}' without 'dictionary'; add dictionary = \"DICT_5X5_100\", or remove it")
    return Chessboard


def board_values(board: Board) -> dict[str, Value]:
    """Return the keys of a board, without its name, at full precision, for storing it in another file."""
    pattern, word = board.pattern, board.pattern.size_word
    per = pattern.points_per_count
    values: dict[str, Value] = {"type": pattern.type, "columns": board.columns // per, "rows": board.rows // per}
    values |= {f"{word}_x_mm": board.square_x_mm, f"{word}_y_mm": board.square_y_mm}
    if board.square_sigma_mm is not None:
        values[f"{word}_sigma_mm"] = board.square_sigma_mm
    return {**values, **pattern.key_values()}


def board_of_values(values: Mapping[str, Any], board_id: str) -> Board:
    """Return the board of `board_values`; raises InputError for others."""
    return board_from_table(TomlTable(values, DECLARED_BOARD, Path(f"board '{board_id}'")), board_id)


def board_text(board: Board, comment: str, path: Path, *, layout: Board | None = None) -> str:
    """Return the content of the board's file `path`; `layout` is the board as printed, if the squares are measured."""
    pattern = board.pattern
    word, per = pattern.size_word, pattern.points_per_count
    lines = [f"# {comment}", f'schema = "{BOARD_SCHEMA}"']
    lines += [] if isinstance(pattern, Chessboard) else [f'type = "{pattern.type}"']
    lines += [f"columns = {board.columns // per}", f"rows = {board.rows // per}"]
    if board.board_id != path.stem:
        lines.append(f"id = {toml_text(board.board_id)}")
    lines += [f"{word}_x_mm = {board.square_x_mm:.6g}", f"{word}_y_mm = {board.square_y_mm:.6g}"]
    if layout is not None:
        lines += [f"printed_x_mm = {layout.square_x_mm:.6g}", f"printed_y_mm = {layout.square_y_mm:.6g}"]
    if board.square_sigma_mm is not None:
        lines.append(f"{word}_sigma_mm = {board.square_sigma_mm:.4g}")
    lines += [f"{name} = {_written(value)}" for name, value in pattern.key_values().items()]
    return "\n".join(lines) + "\n"


def _written(value: Value) -> str:
    return f"{value:.6g}" if isinstance(value, float) else toml_text(value)
