"""Measured truth as people write it: a table of the manifest, or a CSV file kept in a spreadsheet."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TypeVar

from rigkit.core.boards import Board
from rigkit.core.errors import InputError
from rigkit.core.truth import Feature, MeasuredAngle, MeasuredDistance, MeasuredLength, PairTruth
from rigkit.io.toml_reader import TomlTable

Measured = TypeVar("Measured", MeasuredAngle, MeasuredDistance)

HINT_BASELINE = 'baseline = { value_mm = 300.0, sigma_mm = 2.0, how = "steel rule" }'
HINT_ANGLES = 'angles = [ { a = "plane1", b = "plane2", value_deg = 90.0, sigma_deg = 0.3, how = "set square" } ]'
HINT_DISTANCES = (
    'distances = [ { a = "plane1.centre", b = "plane2", value_mm = 300.0, sigma_mm = 1.0, how = "steel rule" } ]'
)


def truth_from_table(table: TomlTable, boards: Sequence[Board]) -> PairTruth:
    """Read `[pairs.truth]`; raises InputError for unknown keys, missing sigmas and boards that are not in the pair."""
    baseline = None
    if table.has("baseline"):
        inner = table.table("baseline", hint=HINT_BASELINE)
        measured = measured_value(inner, "mm")
        inner.done()
        with inner.located():
            baseline = MeasuredLength(*measured)
    angles = _between(table, "angles", HINT_ANGLES, ("deg", ""), boards, make_angle)
    distances = _between(table, "distances", HINT_DISTANCES, ("mm", ".centre"), boards, make_distance)
    table.done()
    return PairTruth(baseline, angles, distances)


def _between(
    table: TomlTable,
    key: str,
    hint: str,
    unit_and_place: tuple[str, str],
    boards: Sequence[Board],
    make: Callable[[str, str, float, float, str, Sequence[Board]], Measured],
) -> tuple[Measured, ...]:
    """Return what was measured between two things each; none where the key is not there."""
    unit, place = unit_and_place
    out = []
    for inner in table.tables(key, hint=hint) if table.has(key) else ():
        a, b = (inner.text(end, hint=f'{end} = "{boards[0].board_id}{place}"') for end in "ab")
        measured = measured_value(inner, unit)
        inner.done()
        with inner.located():
            out.append(make(a, b, *measured, boards))
    return tuple(out)


def make_angle(a: str, b: str, value_deg: float, sigma_deg: float, how: str, boards: Sequence[Board]) -> MeasuredAngle:
    """Return the angle between two boards of the pair; raises InputError for any other board."""
    for board_id in (a, b):
        _board_of(board_id, boards)
    return MeasuredAngle(a, b, value_deg, sigma_deg, how)


def make_distance(
    a: str, b: str, value_mm: float, sigma_mm: float, how: str, boards: Sequence[Board]
) -> MeasuredDistance:
    """Return the distance between two features, written as `Feature` reads them.

    Raises InputError for a board that is not in the pair, a corner that is not on its board, and a corner of a board
    that looks the same turned by 180 degrees: nobody can say which one it is, unless both ends are on that board.
    """
    first, second = Feature.parse(a), Feature.parse(b)
    for feature in (first, second):
        board = _board_of(feature.board_id, boards)
        if feature.grid is None:
            continue
        if feature.grid[0] >= board.columns or feature.grid[1] >= board.rows:
            raise InputError(
                f"{feature} lies outside the {board.columns}x{board.rows} inner corners (counted from 0); "
                "correct the feature"
            )
        if board.looks_same_turned and first.board_id != second.board_id:
            raise InputError(
                f"{feature}: board '{board.board_id}' looks the same turned by 180 degrees, so nobody can say which "
                f"corner this is; measure from '{board.board_id}.centre' instead"
            )
    return MeasuredDistance(first, second, value_mm, sigma_mm, how)


def _board_of(board_id: str, boards: Sequence[Board]) -> Board:
    for board in boards:
        if board.board_id == board_id:
            return board
    raise InputError(f"board '{board_id}' is not in this pair; known: {', '.join(b.board_id for b in boards)}")


def measured_value(table: TomlTable, unit: str) -> tuple[float, float, str]:
    """Return (value, sigma, how); none has a default."""
    value = table.number(f"value_{unit}", hint=f"value_{unit} = 90.0" if unit == "deg" else f"value_{unit} = 300.0")
    sigma = table.number(f"sigma_{unit}", hint=f"sigma_{unit} = 0.5: how far off the measurement may well be")
    return value, sigma, table.text("how", hint='how = "steel rule": by what it was measured')
