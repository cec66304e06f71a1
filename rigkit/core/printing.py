"""Short printed representations of results, without their arrays, and numbers as text."""

from __future__ import annotations

import importlib
from collections.abc import Collection, Mapping
from dataclasses import fields, is_dataclass
from typing import Any

import numpy as np

NOTEBOOK = "rigkit.report.notebook"
"""Module that draws results as HTML, imported by name because it is in a higher layer."""

MAX_LENGTH = 60
"""Characters of one value; longer ones are cut."""
MAX_TOGETHER = 440
"""Characters of all values: less than five lines of a hundred."""
MAX_LISTED = 3
"""Largest collection whose entries are listed; others are counted."""
MAX_DECIMALS = 6
"""Of a value with its sigma, and of lengths: nanometres."""


def brief(self: Any) -> str:
    """Return the representation of a dataclass with short values, shapes of arrays and sizes of collections.

    Classes use it as their `__repr__`.
    """
    values = [f"{field.name}={_value(getattr(self, field.name))}" for field in fields(self)]
    words = ", ".join(values)
    if len(words) > MAX_TOGETHER:
        words = words[: words.rindex(",", 0, MAX_TOGETHER)] + ", ..."
    return f"{type(self).__name__}({words})"


def drawn(self: Any) -> str:
    """Return a result as HTML with a small picture. Classes use it as their `_repr_html_`."""
    return str(importlib.import_module(NOTEBOOK).html_of(self))


def _value(value: Any) -> str:
    if isinstance(value, np.ndarray):
        return f"<{'x'.join(str(n) for n in value.shape)}>"
    if isinstance(value, float):
        return f"{value:.6g}"
    if isinstance(value, str | bytes | type(None)) or not isinstance(value, Collection):
        words = f"<{type(value).__name__}>" if is_dataclass(value) else repr(value)
    elif isinstance(value, Mapping):
        listed = len(value) <= MAX_LISTED
        words = f"{{{', '.join(map(str, value))}}}" if listed else f"<{len(value)} entries>"
    else:
        words = f"<{len(value)} {type(value).__name__}>"
        if len(value) <= MAX_LISTED and all(isinstance(v, str | int | float) for v in value):
            words = repr(value)
    return words.splitlines()[0] if len(words) <= MAX_LENGTH else f"{words.splitlines()[0][:MAX_LENGTH]}..."


def digits(value: float) -> str:
    """Return a number with two significant digits, and without an exponent if it is large: 520, 5.2, 0.052."""
    return f"{float(f'{value:.2g}'):.12g}"


def probability_words(value: float) -> str:
    """Return a probability with two decimals, but never as 0 or 1.

    >>> probability_words(0.5), probability_words(0.0004), probability_words(0.9996)
    ('0.50', '< 0.01', '> 0.99')
    """
    return "< 0.01" if value < 0.01 else "> 0.99" if value > 0.99 else f"{value:.2f}"


def length_words(*mm: float, decimals: int) -> str:
    """Return lengths with so many decimals, or more (nanometres at most) if the largest length would have fewer than
    two significant digits: rigs under a microscope are small.

    >>> length_words(99.934, -0.00412, decimals=2), length_words(0.00412, decimals=2), length_words(0.0, decimals=2)
    ('99.93, -0.00', '0.0041', '0.00')
    """
    largest = max(map(abs, mm))
    if largest > 10.0**-MAX_DECIMALS:
        while decimals < MAX_DECIMALS and largest < 10.0 ** (1 - decimals):
            decimals += 1
    return ", ".join(f"{one:.{decimals}f}" for one in mm)


def counted(count: int, noun: str) -> str:
    """Return a number with its noun: 1 image, 2 images."""
    return f"{count} {noun}{'' if count == 1 else 's'}"
