"""Measured lengths as they are told to `rigkit init`."""

from __future__ import annotations

import math
from collections.abc import Sequence

from rigkit.core.errors import InputError

__all__ = ["told_baselines", "told_length"]


def told_baselines(told: Sequence[str], pairs: Sequence[str]) -> dict[str, tuple[float, float]]:
    """Return pair -> (mm, sigma mm) from PAIR=MM+-SIGMA; raises InputError for other pairs and what is no length."""
    out = {}
    for text in told:
        name, _, value = text.partition("=")
        number, _, sigma = value.partition("+-")
        if name not in pairs:
            raise InputError(f"init: --baseline-mm names '{name}'; pairs found: {', '.join(sorted(pairs))}")
        what = f"--baseline-mm '{text}': write PAIR=MM+-SIGMA, such as {name}=300+-2"
        out[name] = (told_length(what, number), told_length(what, sigma))
    return out


def told_length(what: str, value: str | float) -> float:
    """Return a length in mm; raises InputError where it is no positive number."""
    try:
        number = float(value)
    except ValueError:
        number = math.nan
    if not (math.isfinite(number) and number > 0.0):
        raise InputError(f"init: {what}: a positive number of mm is needed, got '{value}'")
    return number
