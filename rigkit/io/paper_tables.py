"""The paper's tables, kept as CSV with the digits that were printed."""

from __future__ import annotations

import csv
import io
from pathlib import Path

from rigkit.core.errors import InputError
from rigkit.io.reading import read_text
from rigkit.validation.tables import PaperTables

PLANES_FILE = "planes.csv"
BASELINES = "baselines.csv"


def load_paper_tables(folder: str | Path) -> PaperTables:
    """Read `planes.csv` and `baselines.csv` of a folder such as datasets/hajder2021.

    Raises InputError where one is missing, a row has another number of cells than the head, or a cell is no number.
    """
    return PaperTables(_read(Path(folder) / PLANES_FILE), _read(Path(folder) / BASELINES))


def _read(path: Path) -> dict[str, dict[str, str]]:
    head, *rows = list(csv.reader(io.StringIO(read_text(path, "the paper's table")))) or [[]]
    names = [_without_unit(name) for name in head]
    out: dict[str, dict[str, str]] = {}
    for number, row in enumerate(rows, start=2):
        if len(row) != len(names):
            raise InputError(f"{path}: line {number} has {len(row)} cells, the head has {len(names)}; correct it")
        for cell in row[1:]:
            try:
                float(cell)
            except ValueError as error:
                raise InputError(f"{path}: line {number}: {cell!r} is not a number; correct it") from error
        out[_without_unit(row[0])] = dict(zip(names[1:], row[1:], strict=True))
    if not out:
        raise InputError(f"{path}: no rows; restore the file")
    return out


def _without_unit(name: str) -> str:
    """Return "measured" for "measured [mm]"."""
    return name.split("[")[0].strip()
