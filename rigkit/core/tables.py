"""Tables as plain data: columns with units, cells with value, sigma and marks. `rigkit.report.tables` writes them."""

from __future__ import annotations

import re
from dataclasses import dataclass

from rigkit.core.errors import InputError

COLUMN_HEAD = re.compile(r"(?P<label>.*?)(?: \[(?P<unit>.*)\])?(?: \.(?P<decimals>\d))?")


@dataclass(frozen=True, slots=True)
class Column:
    """Head of a column: label, unit and number of decimals."""

    label: str
    unit: str = ""
    decimals: int = 3


@dataclass(frozen=True, slots=True)
class Cell:
    """One entry.

    Attributes
    ----------
    value : number, text, or None if unknown.
    paper : the entry printed in the paper, with its digits, or None.
    sigma : standard deviation of the value, or None.
    best, failed : marks.
    """

    value: float | str | None
    paper: str | None = None
    sigma: float | None = None
    best: bool = False
    failed: bool = False


@dataclass(frozen=True, slots=True)
class Table:
    """A table: every row has one cell for each column; the first column names the row. Raises InputError without
    rows."""

    key: str
    title: str
    columns: tuple[Column, ...]
    rows: tuple[tuple[Cell, ...], ...]
    note: str = ""

    def __post_init__(self) -> None:
        if not self.rows:
            raise InputError(f"table '{self.title}': no rows; nothing was validated")
        for row in self.rows:
            if len(row) != len(self.columns):
                raise InputError(f"table '{self.title}': {len(row)} cells in a row of {len(self.columns)} columns")


def columns(heads: str) -> tuple[Column, ...]:
    """Return columns from text such as "pair | points .0 | angle error [deg] | baseline [mm] .2": label, unit and
    decimals. For labels that a user chose, make a `Column`."""
    found = [COLUMN_HEAD.fullmatch(head.strip()) for head in heads.split("|")]
    return tuple(Column(m["label"], m["unit"] or "", int(m["decimals"] or 3)) for m in found if m is not None)


def cells(*values: float | str | Cell | None) -> tuple[Cell, ...]:
    """Return values as cells; cells are returned unchanged."""
    return tuple(v if isinstance(v, Cell) else Cell(v if v is None or isinstance(v, str) else float(v)) for v in values)


def verdict_cell(passed: bool, otherwise: str = "FAIL") -> Cell:
    """Return "pass", or `otherwise` marked as failed."""
    return Cell("pass" if passed else otherwise, failed=not passed)
