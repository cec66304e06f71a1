"""Measured truth in a spreadsheet: one row for each measurement, with units in the head of the table.

::

    pair,quantity,a,b,value [mm],sigma [mm],value [deg],sigma [deg],how
    first,baseline,,,300,2,,,steel rule between tripod marks
    first,angle,plane1,plane2,,,90,0.3,set square
    first,distance,plane1.centre,plane2,412.5,1,,,steel rule

Lengths may be in mm, cm or m and angles in deg, but value and sigma must be in one unit. Columns may be separated by
commas, semicolons or tabs; numbers have a decimal point.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from pathlib import Path

from rigkit.core.boards import Board
from rigkit.core.errors import InputError
from rigkit.core.truth import MeasuredAngle, MeasuredDistance, MeasuredLength, PairTruth
from rigkit.io.disk.reading import csv_table, fault_of_number, read_text
from rigkit.io.manifests.truth_file import make_angle, make_distance

TO_MM = {"mm": 1.0, "cm": 10.0, "m": 1000.0}
TO_DEG = {"deg": 1.0}
PLAIN = ("pair", "quantity", "a", "b", "how")
QUANTITIES = ("baseline", "angle", "distance")
COLUMN_WITH_UNIT = re.compile(r"^(value|sigma)\s*\[\s*([^\]\s]+)\s*\]$")
EXAMPLE = "pair,quantity,a,b,value [mm],sigma [mm],value [deg],sigma [deg],how"

Row = dict[str, str]
Units = dict[str, tuple[str, float]]


def load_truth_csv(path: str | Path, boards: Mapping[str, Sequence[Board]]) -> dict[str, PairTruth]:
    """Return the measured truth by pair.

    Raises InputError, with the line: a missing, unknown or mixed unit, an unknown column, pair, board or quantity, a
    missing or invalid value or sigma, or a second baseline of a pair.

    Parameters
    ----------
    path : CSV file.
    boards : pair -> its boards; a row about any other pair is an error.
    """
    source = Path(path)
    head, rows = _read(source)
    units = _units(source, head)
    baselines: dict[str, MeasuredLength] = {}
    angles: dict[str, list[MeasuredAngle]] = {}
    distances: dict[str, list[MeasuredDistance]] = {}
    for line, row in rows:
        pair, quantity = row.get("pair", ""), row.get("quantity", "")
        try:
            if pair not in boards:
                raise InputError(f"pair '{pair}' is not in the manifest; known: {', '.join(boards)}")
            if quantity not in QUANTITIES:
                raise InputError(f"quantity '{quantity}' is unknown; known: {', '.join(QUANTITIES)}")
            value, sigma, how = _measured(row, units, "deg" if quantity == "angle" else "mm")
            a, b = row.get("a", ""), row.get("b", "")
            if quantity == "baseline":
                if pair in baselines:
                    raise InputError(f"the baseline of pair '{pair}' is stated twice; keep one row")
                baselines[pair] = MeasuredLength(value, sigma, how)
            elif quantity == "angle":
                angles.setdefault(pair, []).append(make_angle(a, b, value, sigma, how, boards[pair]))
            else:
                distances.setdefault(pair, []).append(make_distance(a, b, value, sigma, how, boards[pair]))
        except InputError as error:
            raise InputError(f"{source}: line {line}: {error}") from error
    named = dict.fromkeys([*baselines, *angles, *distances])
    truths = {}
    for name in named:
        try:
            truths[name] = PairTruth(baselines.get(name), tuple(angles.get(name, ())), tuple(distances.get(name, ())))
        except InputError as error:
            raise InputError(f"{source}: pair '{name}': {error}") from error
    return truths


def _read(source: Path) -> tuple[list[str], list[tuple[int, Row]]]:
    """Return the head and the non-empty rows with their lines."""
    text = read_text(source, "truth table")
    first = next((line for line in text.splitlines() if line.strip() and not line.lstrip().startswith("#")), "")
    delimiter = max(",;\t", key=first.count)
    head, rows = csv_table(source, "truth table", delimiter=delimiter)
    if not rows:
        raise InputError(f"{source}: no measurements; start with the head {EXAMPLE} and add a row each")
    return head, rows


def _units(source: Path, head: Sequence[str]) -> Units:
    """Return the column and the factor to mm or deg of "value mm", "sigma mm", "value deg" and "sigma deg"."""
    units: Units = {}
    for name in head:
        if name in PLAIN:
            continue
        match = COLUMN_WITH_UNIT.match(name)
        if match is None:
            fault = "has no unit" if name in ("value", "sigma") else "is unknown"
            raise InputError(f"{source}: column '{name}' {fault}; write {EXAMPLE}")
        what, unit = match[1], match[2]
        kind, factors = ("deg", TO_DEG) if unit in TO_DEG else ("mm", TO_MM)
        if unit not in factors:
            raise InputError(f"{source}: column '{name}': unknown unit; known: {', '.join([*TO_MM, *TO_DEG])}")
        if f"{what} {kind}" in units:
            raise InputError(
                f"{source}: columns '{units[f'{what} {kind}'][0]}' and '{name}' mix units; keep one of them"
            )
        units[f"{what} {kind}"] = (name, factors[unit])
    for kind in ("mm", "deg"):
        pair = [units.get(f"{what} {kind}") for what in ("value", "sigma")]
        if pair[0] is not None and pair[1] is not None and pair[0][1] != pair[1][1]:
            raise InputError(f"{source}: columns '{pair[0][0]}' and '{pair[1][0]}' mix units; give both in one")
    if len(set(head)) != len(head):
        raise InputError(f"{source}: a column is there twice; the head is {', '.join(head)}; leave one")
    return units


def _measured(row: Row, units: Units, kind: str) -> tuple[float, float, str]:
    """Return (value, sigma, how) of a row in mm or deg."""
    other = "deg" if kind == "mm" else "mm"
    for what in ("value", "sigma"):
        column = units.get(f"{what} {other}")
        if column is not None and row[column[0]]:
            raise InputError(f"'{column[0]}' is filled in for a {row['quantity']}; leave it empty")
    numbers = []
    for what in ("value", "sigma"):
        column = units.get(f"{what} {kind}")
        if column is None:
            raise InputError(f"a {row['quantity']} needs a column '{what} [{kind}]'; add it to the head")
        text = row[column[0]]
        try:
            number = float(text)
        except ValueError as error:
            fault = f"'{text}' is no number" if text else "is empty"
            raise InputError(f"'{column[0]}' {fault}; write it with a decimal point and without unit") from error
        wrong = fault_of_number(number)
        if wrong:
            raise InputError(f"'{column[0]}' must be {wrong}, got {text[:40]}; write what was measured")
        numbers.append(number * column[1])
    if not row.get("how"):
        raise InputError("'how' is empty; say by what it was measured")
    return numbers[0], numbers[1], row["how"]
