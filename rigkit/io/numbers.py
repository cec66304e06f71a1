"""The range of numbers in files that people write: what lies outside is a slip, and would only overflow later."""

from __future__ import annotations

import math

MAX_NUMBER = 1e9
"""A thousand kilometres in mm."""
MIN_POSITIVE = 1e-9
"""A picometre in mm; a measurement with a smaller sigma would outweigh all else."""


def fault_of_number(value: object, *, positive: bool = True) -> str | None:
    """Return what is wrong with a number of a file, in words that follow its name and "must be"; None if nothing is."""
    if isinstance(value, bool) or not isinstance(value, int | float):
        return "a number"
    if isinstance(value, float) and not math.isfinite(value):
        return "a finite number"
    if positive and value <= 0:
        return "positive"
    if abs(value) > MAX_NUMBER:
        return f"at most {MAX_NUMBER:g}"
    if positive and value < MIN_POSITIVE:
        return f"at least {MIN_POSITIVE:g}"
    return None


def is_number(text: str) -> bool:
    """Say whether words are a number."""
    try:
        float(text)
    except ValueError:
        return False
    return True
