"""The page of the margins of detection's constants, from the rows that `measure_constants.py` prints."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

PAGE = Path(__file__).parents[2] / "docs/pages/detection-constants.md"
ROW = re.compile(r"^\| ([a-z_.]+)\.(\w+(?:\[\d+\])?) \| (\S+) \| (\d+) \| (.*) \| (.*) \|$", re.MULTILINE)
IMAGES = re.compile(r"^(?:REAL|RENDERED): \d+ images.*$", re.MULTILINE)
NO_FACTOR = ("same", "-", "not called", "not read", "no other value")

Row = tuple[str, str, str, str, str, str]
"""Module, constant, value, images, and what smaller and larger values do."""

WORDS = """\
# Detection: how far each constant can be changed

Each number that `rigkit.detection` decides by was divided and multiplied by 1.25, 2 and 4, one at a time. The table
gives, on both sides, the smallest of these factors that has an effect, and the effect: corners lost (more than 1 %),
false boards found, corners moved (more than 0.3 of their sigmas, rms), or sigmas changed (more than 10 %, rms). "-"
means that even a factor of 4 has none of these effects, "same" that it changes no digit, "not called" that no image
leads to the constant, "no other value" that the code takes none. What each constant separates is said beside it in
the source.

{images}

Measured on {date} by `scripts/measure_constants.py`; `scripts/detection_bench/constant_looks.py` lists the images. Of
{total} numbers, {both} have an effect on both sides, {one} on one side, {none} on none; for {near} of them a factor of
1.25 has one.

A constant without an effect here may still belong to a mechanism that decides. Without the whole mechanism, boards are
lost on other images: the outlines of markers (ChArUco boards of two rows of corners), the second look at a sample of a
large board (motion of 12 px), parts joined across two hidden rows, tags alone where light parts them from the squares
between.
"""


def rows_of(printed: str) -> dict[tuple[str, str], Row]:
    """Return the last row of each constant (module and name) among what was printed or is in the page."""
    return {(row[0], row[1]): row for row in ROW.findall(printed)}


def page(printed: str, constants: Sequence[tuple[str, str]], date: str) -> str:
    """Return the page of the `constants` (module and name) that were measured."""
    rows = rows_of(printed)
    kept = [rows[one] for one in constants if one in rows]
    counts = [sum(side not in NO_FACTOR for side in row[4:]) for row in kept]
    parts = [
        WORDS.format(
            images="\n".join(dict.fromkeys(IMAGES.findall(printed)[-2:])),
            date=date,
            total=len(kept),
            both=counts.count(2),
            one=counts.count(1),
            none=counts.count(0),
            near=sum(any(_factor(side).startswith("1.25: ") for side in row[4:]) for row in kept),
        )
    ]
    module = ""
    for path, name, value, looks, smaller, larger in kept:
        if path != module:
            head = "| constant | value | images | smaller by | larger by |\n| :-- | --: | --: | :-- | :-- |"
            parts.append(f"\n## {path}\n\n{head}\n")
            module = path
        parts.append(f"| {path}.{name} | {value} | {looks} | {_factor(smaller)} | {_factor(larger)} |\n")
    return "".join(parts)


def _factor(side: str) -> str:
    """Return the effect with a factor above 1."""
    number, colon, effect = side.partition(": ")
    if not colon:
        return side
    by = float(number)
    return f"{max(by, 1.0 / by):.3g}: {effect}"
