"""Corners on disk: CSV with the columns image, board, column, row, u_px, v_px, sigma_px, one corner a line.

A board without a name is written as `?NUMBER:COLUMNSxROWS`, counted from 1 in each image, so that reading gives back
what was found.
"""

from __future__ import annotations

import csv
import io
import re
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from rigkit.core.boards import Board
from rigkit.core.detections import BoardDetection
from rigkit.core.errors import InputError
from rigkit.io.files import write_atomic
from rigkit.io.text import read_text

__all__ = ["COLUMNS", "corners_text", "read_corners", "write_corners"]

COLUMNS = ("image", "board", "column", "row", "u_px", "v_px", "sigma_px")

UNNAMED = re.compile(r"^\?\d+:(\d+)x(\d+)$")


def corners_text(detections: Mapping[str, Sequence[BoardDetection]]) -> str:
    """Return the file's text for the detections of each image, in the order given."""
    stream = io.StringIO()
    writer = csv.writer(stream, lineterminator="\n")
    writer.writerow(COLUMNS)
    for image, boards in detections.items():
        for number, found in enumerate(boards, 1):
            name = found.board_id or f"?{number}:{found.columns}x{found.rows}"
            for (column, row), (u, v), sigma in zip(found.grid, found.pixels, found.sigma_px, strict=True):
                writer.writerow((image, name, column, row, f"{u:.5f}", f"{v:.5f}", f"{sigma:.5f}"))
    return stream.getvalue()


def write_corners(path: str | Path, detections: Mapping[str, Sequence[BoardDetection]], *, force: bool = False) -> None:
    """Write the detections of each image to `path`; raises InputError as `write_atomic` does."""
    write_atomic(path, corners_text(detections), force=force)


def read_corners(path: str | Path, boards: Sequence[Board] = ()) -> dict[str, tuple[BoardDetection, ...]]:
    """Return the detections of each image, in the order of the file.

    The size of a named board is that of `boards`; where the name is not among them, the largest column and row read.

    Raises
    ------
    InputError
        No such file, other columns, or a line that cannot be understood; names the line.
    """
    source = Path(path)
    lines = csv.reader(io.StringIO(read_text(source, "corners file")))
    if tuple(next(lines, ())) != COLUMNS:
        raise InputError(f"corners file '{source}': the first line must be {','.join(COLUMNS)}")
    rows: dict[str, dict[str, list[tuple[float, ...]]]] = {}
    for number, line in enumerate(lines, 2):
        try:
            image, board, *numbers = line
            column, row = int(numbers[0]), int(numbers[1])
            u, v, sigma = (float(value) for value in numbers[2:])
            if not np.isfinite([u, v, sigma]).all():
                raise ValueError("a value is NaN or infinite")
            if not sigma > 0.0:
                raise ValueError(f"sigma_px is {sigma:g} and must be positive")
        except (ValueError, IndexError) as error:
            raise InputError(
                f"corners file '{source}', line {number}: {error}; expected {','.join(COLUMNS)}"
            ) from error
        rows.setdefault(image, {}).setdefault(board, []).append((column, row, u, v, sigma))
    sizes = {board.board_id: board.size for board in boards}
    try:
        return {
            image: tuple(_detection(name, values, sizes) for name, values in found.items())
            for image, found in rows.items()
        }
    except (InputError, OverflowError) as error:
        raise InputError(f"corners file '{source}': {error}") from error


def _detection(name: str, values: list[tuple[float, ...]], sizes: Mapping[str, tuple[int, int]]) -> BoardDetection:
    table = np.array(values)
    grid = table[:, :2].astype(np.int64)
    if len(np.unique(grid, axis=0)) < len(grid):
        raise InputError(f"board '{name}': a corner is listed twice; leave one")
    unnamed = UNNAMED.match(name)
    if unnamed:
        columns, rows = int(unnamed[1]), int(unnamed[2])
    else:
        largest = grid.max(axis=0) + 1
        columns, rows = sizes.get(name, (int(largest[0]), int(largest[1])))
    return BoardDetection(None if unnamed else name, columns, rows, grid, table[:, 2:4], table[:, 4])
