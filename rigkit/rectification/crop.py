"""Cropping of rectified images to a large axis-aligned rectangle without unseen pixels."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from rigkit.core.arrays import BoolArray, FloatArray, sampling_step
from rigkit.core.errors import DegenerateError
from rigkit.rectification.rectify import RectifyMap

COARSE = 300
"""Cells along the longer side of the coarse grid on which the rectangle is found before it grows by single pixels."""


def cropped(maps: Sequence[RectifyMap]) -> tuple[RectifyMap, ...]:
    """Return `maps`, which share one target, with that target cropped to what every camera sees.

    Only the target's size and principal point change. Raises DegenerateError if no pixel is seen by all cameras.
    """
    seen = np.logical_and.reduce([one.coverage() for one in maps])
    left, top, right, bottom = largest_rectangle(seen)
    if right == left:
        raise DegenerateError("crop: no part of the view is seen by all cameras; choose another view")
    target = maps[0].target
    parameters: FloatArray = target.parameters.copy()
    parameters[2:4] -= (left, top)
    part = type(target)((right - left, bottom - top), parameters)
    return tuple(replace(one, target=part) for one in maps)


def largest_rectangle(seen: BoolArray) -> tuple[int, int, int, int]:
    """Return (left, top, right, bottom), ends excluded, of a large rectangle of True; empty where nothing is True.

    It is the largest one of coarse cells, grown by single rows and columns as far as possible.
    """
    step = sampling_step(max(seen.shape), COARSE)
    rows, columns = (size // step for size in seen.shape)
    cells = seen[: rows * step, : columns * step].reshape(rows, step, columns, step)
    left, top, right, bottom = (step * edge for edge in _largest_true_rectangle(np.asarray(cells.all(axis=(1, 3)))))
    if right == left:
        return 0, 0, 0, 0
    grown = True
    while grown:
        grown = False
        if left > 0 and seen[top:bottom, left - 1].all():
            left, grown = left - 1, True
        if right < seen.shape[1] and seen[top:bottom, right].all():
            right, grown = right + 1, True
        if top > 0 and seen[top - 1, left:right].all():
            top, grown = top - 1, True
        if bottom < seen.shape[0] and seen[bottom, left:right].all():
            bottom, grown = bottom + 1, True
    return left, top, right, bottom


def _largest_true_rectangle(whole: BoolArray) -> tuple[int, int, int, int]:
    """Return the largest rectangle of True cells: the largest one in each row's histogram of heights, by a stack."""
    best, found = 0, (0, 0, 0, 0)
    height = np.zeros(whole.shape[1], dtype=np.int64)
    for row, cells in enumerate(whole):
        height = np.where(cells, height + 1, 0)
        stack: list[tuple[int, int]] = []  # (first column, height), rising
        for column, h in enumerate([*height.tolist(), 0]):
            first = column
            while stack and stack[-1][1] >= h:
                first, tall = stack.pop()
                if tall * (column - first) > best:
                    best, found = tall * (column - first), (first, row + 1 - tall, column, row + 1)
            stack.append((first, h))
    return found
