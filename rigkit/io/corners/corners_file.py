"""Corner files: CSV with the columns image, board, column, row, u_px, v_px, sigma_px, one corner a line.

Columns and rows count from the upper left of the upright board. Kalibr counts an AprilGrid's corners row by row from
the lower left: there column c of row r, of C x R corners, has number (R - 1 - r) C + c.

A board without an id is written as `?NUMBER:COLUMNSxROWS`, numbered from 1 in each image.

The corner cache `corners.json` is read, too, and `corners.vnl` of mrgingham and mrcal: a line `# filename x y level`,
then all corners of the one board in each image, row by row, with '-' for missing ones. The level is that of the image
pyramid: each one doubles the standard deviation (mrgingham's manual).
"""

from __future__ import annotations

import csv
import io
import math
import re
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from rigkit.core.boards import Board
from rigkit.core.detections import BoardDetection
from rigkit.core.errors import InputError
from rigkit.io.corners.corner_cache import kept_corners
from rigkit.io.disk.json_reader import parse_json
from rigkit.io.disk.reading import csv_rows, on_one_line, read_text
from rigkit.io.disk.writing import write_atomic

COLUMNS = ("image", "board", "column", "row", "u_px", "v_px", "sigma_px")

LEVEL_0_SIGMA_PX = 0.1
"""Standard deviation of a .vnl file's corner at level 0; a calibration estimates the true scale."""
MAX_LEVEL = 10
VNL_COLUMNS = {"filename", "x", "y"}

UNNAMED = re.compile(r"^\?\d+:(\d+)x(\d+)$")


def corners_text(detections: Mapping[str, Sequence[BoardDetection]]) -> str:
    """Return the CSV text of the detections by image, in the order given."""
    stream = io.StringIO()
    writer = csv.writer(stream, lineterminator="\n")
    writer.writerow(COLUMNS)
    for image, boards in detections.items():
        # CSV readers end a line at \r, quoted or not.
        image = image.replace("\r", "\\r")
        for number, found in enumerate(boards, 1):
            name = found.board_id or f"?{number}:{found.columns}x{found.rows}"
            for (column, row), (u, v), sigma in zip(found.grid, found.pixels, found.sigma_px, strict=True):
                writer.writerow((image, name, column, row, f"{u:.5f}", f"{v:.5f}", f"{sigma:.5f}"))
    return stream.getvalue()


def write_corners(path: str | Path, detections: Mapping[str, Sequence[BoardDetection]], *, force: bool = False) -> None:
    """Write the detections of each image to `path`; raises InputError as `write_atomic` does."""
    write_atomic(path, corners_text(detections), force=force)


def read_corners(path: str | Path, boards: Sequence[Board] = ()) -> dict[str, tuple[BoardDetection, ...]]:
    """Return the detections by image, in the order of the file.

    The size of a named board is that in `boards`, or else the largest column and row read. A .vnl file needs exactly
    one board.

    Raises InputError: no such file, other columns, or, with its number, an invalid line.
    """
    source = Path(path)
    text = read_text(source, "corners file")
    if text.lstrip().startswith("{"):
        return _from_json(source, text)
    if text.startswith("#"):
        return _from_vnl(source, text, boards)
    lines = csv_rows(source, "corners file")
    if tuple(next(lines, (0, []))[1]) != COLUMNS:
        raise InputError(f"corners file '{source}': the first line must be {','.join(COLUMNS)}")
    rows: dict[str, dict[str, list[tuple[float, ...]]]] = {}
    for number, line in lines:
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
        raise InputError(f"corners file '{source}': {error}; correct the lines, or detect the corners again") from error


def _from_json(source: Path, text: str) -> dict[str, tuple[BoardDetection, ...]]:
    """Return the detections of a corner cache."""
    try:
        return {image: found.detections for image, found in kept_corners(parse_json(text)).items()}
    except (ValueError, TypeError, KeyError, AttributeError, OverflowError, InputError) as error:
        raise InputError(
            f"corners file '{source}': damaged ({on_one_line(error)}); detect the corners again"
        ) from error


def _from_vnl(source: Path, text: str, boards: Sequence[Board]) -> dict[str, tuple[BoardDetection, ...]]:
    """Return the detections of a file of mrgingham or mrcal, which has one board."""
    if len(boards) != 1:
        raise InputError(f"corners file '{source}' is about one board, and {len(boards)} are given; give that one")
    names: list[str] = []
    corners: dict[str, list[tuple[float, float, float]]] = {}
    for number, line in enumerate(text.splitlines(), 1):
        words = line.split()
        if line.startswith("#") or not words:
            if not names and not line.startswith(("##", "#!")):
                names = line.lstrip("#").split()
                if not set(names) >= VNL_COLUMNS:
                    raise InputError(f"corners file '{source}', line {number}: the columns must be filename x y level")
            continue
        cells = dict(zip(names, words, strict=False))
        try:
            corners.setdefault(cells["filename"], []).append(_vnl_corner(cells))
        except (ValueError, KeyError) as error:
            raise InputError(
                f"corners file '{source}', line {number}: {error}; expected {' '.join(names)}, '-' for what is absent"
            ) from error
    return {image: _vnl_detections(source, image, found, boards[0]) for image, found in corners.items()}


def _vnl_corner(cells: Mapping[str, str]) -> tuple[float, float, float]:
    """Return u, v, sigma of a line; NaN for a missing corner."""
    absent = (math.nan, math.nan, math.nan)
    if "-" in (cells["x"], cells["y"], cells.get("level"), cells.get("weight")):
        return absent
    u, v, scale = float(cells["x"]), float(cells["y"]), 2.0 ** min(float(cells.get("level", "0")), MAX_LEVEL + 1)
    if "weight" in cells:
        weight = float(cells["weight"])
        if weight <= 0.0:
            return absent
        scale = 1.0 / weight
    if not (math.isfinite(u + v) and 2.0**-MAX_LEVEL <= scale <= 2.0**MAX_LEVEL):
        raise ValueError("a value is NaN, infinite or no level")
    return (u, v, LEVEL_0_SIGMA_PX * scale)


def _vnl_detections(
    source: Path, image: str, corners: list[tuple[float, float, float]], board: Board
) -> tuple[BoardDetection, ...]:
    """Return the board's detection; () without any corner."""
    table = np.array(corners)
    found = ~np.isnan(table[:, 0])
    if not found.any():
        return ()
    if len(table) != board.corner_count:
        raise InputError(
            f"corners file '{source}': image '{image}' has {len(table)} lines, board '{board.board_id}' of "
            f"{board.columns}x{board.rows} has {board.corner_count} corners; give the board that was detected"
        )
    grid = board.grid()[found]
    return (BoardDetection(board.board_id, board.columns, board.rows, grid, table[found, :2], table[found, 2]),)


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
