"""Measured truth in tables of manifests and sessions."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from rigkit.core.boards import Board
from rigkit.core.errors import InputError
from rigkit.core.truth import Feature, MeasuredAngle, MeasuredDistance, MeasuredLength, PairTruth
from rigkit.io.disk.schema_builders import POSITIVE, TEXT, Schema, array, described, obj
from rigkit.io.disk.toml_reader import TomlTable


def measured(unit: str) -> dict[str, Schema]:
    """Return the keys of a measurement in `unit`."""
    return {
        f"value_{unit}": described(POSITIVE, f"as measured, {unit}", {"deg": 90.0, "mm": 300.0}[unit]),
        f"sigma_{unit}": described(POSITIVE, "standard deviation of the measurement", 0.5),
        "how": described(TEXT, "instrument: steel rule, set square, calipers", "steel rule"),
    }


def between(unit: str, what: str, a: str, b: str) -> Schema:
    """Return the schema of a measurement between two things, such as `a` and `b`."""
    return obj({"a": described(TEXT, what, a), "b": described(TEXT, "the other one", b), **measured(unit)})


_SQUARE = {"a": "plane1", "b": "plane2", "value_deg": 90.0, "sigma_deg": 0.3, "how": "set square"}
_DISTANCE = {"a": "plane1.centre", "b": "plane2", "value_mm": 300.0, "sigma_mm": 1.0, "how": "steel rule"}
TRUTH_KEYS: Mapping[str, Schema] = {
    "angles?": described(
        array(between("deg", "a board", "plane1", "plane2")), "angles between boards, across their faces", [_SQUARE]
    ),
    "distances?": described(
        array(between("mm", "a place: plane1, plane1.centre, plane1[0,5]", "plane1.centre", "plane2")),
        "distances between places",
        [_DISTANCE],
    ),
}


def truth_from_table(table: Mapping[str, Any], boards: Sequence[Board]) -> PairTruth:
    """Return the truth of a table of TRUTH_KEYS and perhaps a baseline; raises InputError for other boards."""
    baseline, angles, distances = None, [], []
    if (inner := table.get("baseline")) is not None:
        with inner.located():
            baseline = MeasuredLength(*measured_value(inner, "mm"))
    for inner in table.get("angles", ()):
        with inner.located():
            angles.append(make_angle(inner["a"], inner["b"], *measured_value(inner, "deg"), boards))
    for inner in table.get("distances", ()):
        with inner.located():
            distances.append(make_distance(inner["a"], inner["b"], *measured_value(inner, "mm"), boards))
    return PairTruth(baseline, tuple(angles), tuple(distances))


def make_angle(a: str, b: str, value_deg: float, sigma_deg: float, how: str, boards: Sequence[Board]) -> MeasuredAngle:
    """Return the angle between two boards of the pair; raises InputError for any other board."""
    for board_id in (a, b):
        _board_of(board_id, boards)
    return MeasuredAngle(a, b, value_deg, sigma_deg, how)


def make_distance(
    a: str, b: str, value_mm: float, sigma_mm: float, how: str, boards: Sequence[Board]
) -> MeasuredDistance:
    """Return the distance between two features in the notation of `Feature`.

    Raises InputError for a board that is not in the pair, a corner outside of its board, or a corner of a board that is
    symmetric under a half turn, which is ambiguous unless both features are on that board.
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
    """Return (value, sigma, how)."""
    return table[f"value_{unit}"], table[f"sigma_{unit}"], table["how"]
