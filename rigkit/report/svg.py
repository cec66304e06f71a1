"""Common parts of SVG drawings, and round numbers for axes and scales."""

from __future__ import annotations

from collections.abc import Sequence
from html import escape

import numpy as np
from numpy.typing import NDArray

from rigkit.core.arrays import FloatArray

DRAWN_WIDTH = 600.0
"""Width of most drawings, in SVG units."""
RIM_COLOUR, GROUND_COLOUR, WORDS_COLOUR, GRID_COLOUR = "#b8c0cc", "#fbfcfd", "#333", "#e3e7ee"
INK, MARK, WRONG, SOFT = "#1f4e8c", "#e6550d", "#b3261e", "#8a94a3"
"""Colours of normal, highlighted, wrong and reference elements."""
ROUND = (1.0, 2.0, 5.0, 10.0)


def opening_tag(title: str, box: str, *, size: float = 13, more: str = "") -> str:
    """Return the opening of a drawing with the viewBox `box`, the font `size` and `more` attributes."""
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="{box}" role="img" font-family="sans-serif" '
        f'font-size="{size:g}"{more and f" {more}"}><title>{escape(title)}</title>'
    )


def image_ground(title: str, width: float, height: float) -> str:
    """Return the opening of a drawing over an image, with the image's frame."""
    return (
        opening_tag(title, f"-1 -1 {width + 2:g} {height + 2:.1f}")
        + f'<rect width="{width:g}" height="{height:.1f}" fill="{GROUND_COLOUR}" stroke="{RIM_COLOUR}"/>'
    )


def label(x: float, y: float, text: str, anchor: str = "start", colour: str = WORDS_COLOUR) -> str:
    """Return a line of text."""
    return f'<text x="{x:.1f}" y="{y:.1f}" text-anchor="{anchor}" fill="{colour}">{escape(text)}</text>'


def line(points: FloatArray | Sequence[FloatArray]) -> str:
    """Return the path through points (N, 2)."""
    return "M" + "L".join(f"{x:.1f} {y:.1f}" for x, y in points)


def dots(at: FloatArray) -> str:
    """Return a path of dots at points (N, 2), for strokes with round ends."""
    return "".join(f"M{x:.1f} {y:.1f}h0" for x, y in at)


def strokes(start: FloatArray, by: FloatArray) -> str:
    """Return a path of strokes from `start` (N, 2) to `start` + `by`."""
    return "".join(f"M{x:.1f} {y:.1f}l{dx:.1f} {dy:.1f}" for (x, y), (dx, dy) in zip(start, by, strict=True))


def round_up(value: float, steps: Sequence[float] | NDArray[np.float64] = ROUND) -> float:
    """Return the smallest of `steps` (from 1 to 10) times a power of ten that is at least `value`."""
    power = _power(value)
    return float(next(m * power for m in steps if m * power >= value * (1.0 - 1e-12)))


def round_down(value: float) -> float:
    """Return the largest of 1, 2, 5 times a power of ten that is at most `value`."""
    power = _power(value)
    return float(max(m * power for m in ROUND if m * power <= value * (1.0 + 1e-12)))


def _power(value: float) -> float:
    return float(10.0 ** np.floor(np.log10(max(value, 1e-12))))
