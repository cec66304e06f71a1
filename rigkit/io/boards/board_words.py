"""Boards in words, as on the command line: "9x6x25", "aprilgrid:6x6x88,spacing=0.3", or a file."""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import fields
from pathlib import Path

from rigkit.core.boards import Board
from rigkit.core.errors import InputError
from rigkit.core.patterns.base import Key
from rigkit.core.patterns.chessboard import Chessboard
from rigkit.core.patterns.registry import PATTERNS, pattern_type
from rigkit.io.boards.board_file import DECLARED_BOARD, load_board, measured_board
from rigkit.io.boards.foreign_boards import FOREIGN_SUFFIXES
from rigkit.io.disk.reading import usable_path
from rigkit.io.disk.toml_reader import TomlTable

BOARD_WORDS = re.compile(
    r"^(?:(?P<type>[a-z]+):)?(?P<columns>\d{1,4})[xX](?P<rows>\d{1,4})"
    r"(?:[xX]|, ?)(?P<mm>\d{1,4}(?:\.\d{1,4})?)(?: ?mm)?(?P<keys>(?:,\w+=[\w.+-]+)*)$"
)
COUNTS = re.compile(r"\d{1,4}[xX]\d{1,4}")
"""A board without its scale."""
WORDS_HELP = "9x6x25 (inner corners along and across, mm a square), aprilgrid:6x6x88,spacing=0.3 (tags, mm a tag)"


def board_in_words(words: str) -> Board | None:
    """Return the board described by `words`, named after type, size and first mark; None if they are a file name.

    The form is TYPE:COLUMNSxROWSxMM,KEY=VALUE,... with the types and keys of board files. Without TYPE it is a
    chessboard, which may also be written "9x6, 30 mm".

    Raises InputError for invalid words.
    """
    match = BOARD_WORDS.match(words)
    if match is None:
        kind = words.partition(":")[0]
        if kind in PATTERNS and kind != words:
            raise InputError(f"board '{words}': write TYPE:COLUMNSxROWSxMM,KEY=VALUE, such as {WORDS_HELP}")
        return None
    kind = match["type"] or Chessboard.type
    pattern = pattern_type(kind)
    known = {key.name: key.kind for key in pattern.keys}
    values: dict[str, object] = {"type": kind, "columns": int(match["columns"]), "rows": int(match["rows"])}
    values[f"{pattern.size_word}_mm"] = float(match["mm"])
    for pair in filter(None, match["keys"].split(",")):
        name, _, value = pair.partition("=")
        values[name] = _value(words, name, value, known.get(name, str))
    lacking = [key for key in pattern.keys if key.required and key.name not in values]
    if lacking:
        names = " and ".join(f"'{key.name}'" for key in lacking)
        such = ",".join([words, *(_key_in_words(key) for key in lacking)])
        raise InputError(
            f"board '{words}': {names} {'are' if lacking[1:] else 'is'} missing; write, with your values, {such}"
        )
    first = values.get("first_tag") or values.get("first_marker")
    size = f"{match['columns']}x{match['rows']}x{float(match['mm']):g}"
    name = "-".join([match["type"] or "board", size, *([f"first{first}"] if first else [])])
    return measured_board(TomlTable(values, DECLARED_BOARD, Path(f"board '{words}'")), name)


def board_of_words(words: str | Path) -> Board:
    """Return the board in words, such as "9x6x25" (see `board_in_words`), or in a file; raises InputError for anything
    else."""
    words = str(words)
    board = board_in_words(words)
    if board is not None:
        return board
    if not words.endswith((".toml", *FOREIGN_SUFFIXES)) and not usable_path(words).is_file():
        if COUNTS.fullmatch(words):
            raise InputError(f"--board {words}: say how large a square is as well: {words}x25 where its side is 25 mm")
        raise InputError(f"--board {words}: write {WORDS_HELP}, or a board file")
    return load_board(words)


def board_files(words: Iterable[str]) -> list[Path]:
    """Return the board files among the arguments of --board."""
    return [Path(one) for one in words if board_in_words(one) is None]


def words_of_board(board: Board) -> str:
    """Return the words for a board of unknown scale, with MM in place of the length."""
    pattern, per = board.pattern, board.pattern.points_per_count
    typical = {f.name: f.default for f in fields(pattern)}
    keys = [
        f"{key.name}={_written(getattr(pattern, key.field))}"
        for key in pattern.keys
        if key.required or getattr(pattern, key.field) != typical[key.field]
    ]
    kind = "" if isinstance(pattern, Chessboard) else f"{pattern.type}:"
    words = ",".join([f"{kind}{board.columns // per}x{board.rows // per}xMM", *keys])
    return re.sub(r"_mm=([0-9.]+)", r"_mm=(\1 MM)", words)


def with_length(words: str, length_mm: float) -> str:
    """Return the words of `words_of_board` with a length in place of MM.

    >>> with_length("circles:10x8xMM,diameter_mm=(0.6 MM)", 25.0)
    'circles:10x8x25,diameter_mm=15'
    """
    words = re.sub(r"\(([0-9.]+) MM\)", lambda part: f"{float(part[1]) * length_mm:.4g}", words)
    return words.replace("xMM", f"x{length_mm:.8g}")


def _key_in_words(key: Key) -> str:
    """Return the example of a key, 'marker_mm = 22.0 (with the black border)', as words take it: marker_mm=22.0."""
    return key.hint.partition(" (")[0].replace(" ", "").replace('"', "")


def _written(value: object) -> str:
    return str(value).lower() if isinstance(value, bool) else str(value)


def _value(words: str, name: str, value: str, kind: type) -> object:
    if kind is bool:
        if value not in ("true", "false"):
            raise InputError(f"board '{words}': {name} must be true or false, got {value}")
        return value == "true"
    try:
        return kind(value)
    except ValueError as error:
        raise InputError(f"board '{words}': {name} must be a number, got {value}") from error
