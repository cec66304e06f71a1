"""Selection, replacement and concatenation of the rows of classes whose members are arrays with one row per circle."""

from __future__ import annotations

from dataclasses import fields
from typing import TypeVar

import numpy as np

from rigkit.core.arrays import BoolArray
from rigkit.detection.circles.fit import CircleFit
from rigkit.detection.circles.local_map import PlaneMap

Rows = TypeVar("Rows", CircleFit, PlaneMap)


def rows_of(table: Rows, which: BoolArray) -> Rows:
    """Return the rows `which` of a class of arrays."""
    return type(table)(**{name: getattr(table, name)[which] for name in _names(table)})


def with_rows(table: Rows, which: BoolArray, others: Rows) -> Rows:
    """Return a class of arrays with the rows `which` from `others`, which has as many."""
    rows = {}
    for name in _names(table):
        rows[name] = getattr(table, name).copy()
        rows[name][which] = getattr(others, name)[which]
    return type(table)(**rows)


def joined(one: Rows, two: Rows) -> Rows:
    return type(one)(**{name: np.concatenate([getattr(one, name), getattr(two, name)]) for name in _names(one)})


def _names(table: CircleFit | PlaneMap) -> list[str]:
    return [field.name for field in fields(table)]
