"""Tables as plain data: columns with units, cells with a value, its sigma and marks.

How a table looks as text is the business of `rigkit.report.tables`.
"""

from __future__ import annotations

from dataclasses import dataclass

from rigkit.core.errors import InputError


@dataclass(frozen=True, slots=True)
class Column:
    """Head of a column: label, unit and how many decimals its numbers show."""

    label: str
    unit: str = ""
    decimals: int = 3


@dataclass(frozen=True, slots=True)
class Cell:
    """One entry.

    Attributes
    ----------
    value : number, text, or None for nothing known.
    paper : what the paper printed there, with the digits it has, or None.
    sigma : standard deviation of the value, or None.
    best, failed : how it is marked.
    """

    value: float | str | None
    paper: str | None = None
    sigma: float | None = None
    best: bool = False
    failed: bool = False


@dataclass(frozen=True, slots=True)
class Table:
    """A table: every row has one cell a column; the first column names the row. It cannot be built without rows."""

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
