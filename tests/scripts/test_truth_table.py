"""Numbers in the table of truth have as many digits as are significant."""

from __future__ import annotations

import sys

import pytest
from helpers.data import REPOSITORY

sys.path.insert(0, str(REPOSITORY / "scripts"))

from truth.table import RIGKIT, Row, long_table, number, short_table


@pytest.mark.parametrize(
    ("value", "unit", "words"),
    [
        (0.2, "px", "0.200"),
        (0.0694, "mm", "0.0694"),
        (5.3, "px", "5.30"),
        (119.888, "mm", "119.89"),
        (390.0, "", "390"),
        (None, "px", ""),
    ],
)
def test_digits(value: float | None, unit: str, words: str) -> None:
    assert number(value, unit) == words


def test_counts_and_lengths_in_both_tables() -> None:
    rows = [
        Row(set="board", quantity="tags found", unit="", tool=RIGKIT, value=390.0),
        Row(set="board", quantity="width", unit="mm", tool=RIGKIT, value=2.1, truth=2.0, truth_sigma=0.1, sigma=0.1),
    ]
    assert "| board | tags found |  | 390 |  |  |  |" in short_table(rows)
    assert "|  | width, mm | 2.00 ± 0.100 | 2.10 ± 0.100 |  |  |  |" in short_table(rows)
    assert "| 2.10 | 0.100 | 2.00 ± 0.100 | 0.100 | 0.707 |" in long_table(rows)
