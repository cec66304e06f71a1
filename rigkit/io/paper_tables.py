"""The paper's tables, kept as CSV with the digits that were printed."""

from __future__ import annotations

from pathlib import Path

from rigkit.core.errors import InputError
from rigkit.io.numbers import is_number
from rigkit.io.reading import csv_table
from rigkit.validation.tables import PaperTables

PLANES_FILE = "planes.csv"
BASELINES = "baselines.csv"


def load_paper_tables(folder: str | Path) -> PaperTables:
    """Read `planes.csv` and `baselines.csv` of a folder such as datasets/hajder2021.

    Raises InputError where one is missing, a row has another number of cells than the head, or a cell is no number.
    """
    return PaperTables(_read(Path(folder) / PLANES_FILE), _read(Path(folder) / BASELINES))


def _read(path: Path) -> dict[str, dict[str, str]]:
    head, rows = csv_table(path, "the paper's table")
    out: dict[str, dict[str, str]] = {}
    for line, row in rows:
        name, *cells = row.values()
        for cell in cells:
            if not is_number(cell):
                raise InputError(f"{path}: line {line}: {cell!r} is not a number; correct it")
        out[_without_unit(name)] = dict(zip(map(_without_unit, head[1:]), cells, strict=True))
    if not out:
        raise InputError(f"{path}: no rows; restore the file")
    return out


def _without_unit(name: str) -> str:
    """Return "measured" for "measured [mm]"."""
    return name.split("[")[0].strip()
