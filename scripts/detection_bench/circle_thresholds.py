"""Measure the margin of `GridEvidence`'s limit between circle grids and other lattices of blobs."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import astuple, fields

import numpy as np
from numpy.typing import NDArray

from rigkit.core.boards import Board
from rigkit.core.patterns.circles import Circles
from rigkit.detection.circles.evidence import (
    CORNERED,
    DISPLACED,
    MAX_IMPLAUSIBILITY,
    MISSHAPEN,
    UNEXPLAINED,
    GridEvidence,
)
from rigkit.detection.circles.search import CircleSearch

BOARDS = (
    Board("regular", 10, 8, 25.0, 25.0, pattern=Circles(diameter_mm=15.0)),
    Board("hexagonal", 12, 9, 20.0, 20.0, pattern=Circles("hexagonal", diameter_mm=16.7)),
    Board("light", 4, 11, 40.0, 40.0, pattern=Circles("asymmetric", diameter_mm=16.0, inverted=True)),
)
SCALES = (UNEXPLAINED, MISSHAPEN, DISPLACED, CORNERED)
SHOWN = 5


def print_circle_margins(looks: Iterable[tuple[str, bool, NDArray[np.uint8]]]) -> None:
    """Print what lattices of blobs weigh in images (name, whether it shows a grid of circles, pixels): of each the
    largest where there is a grid, all where there is none."""
    seen: dict[bool, list[tuple[str, GridEvidence]]] = {True: [], False: []}
    nothing = []
    for name, shows, pixels in looks:
        grids = sorted(CircleSearch(pixels).seen(), key=len, reverse=True)
        seen[shows] += [(name, grid.evidence) for grid in (grids[:1] if shows else grids)]
        nothing += [name] if shows and not grids else []
    print(f"\ncircles: {len(nothing)} images of grids without a lattice of circles:", "; ".join(nothing[:SHOWN]))
    names = [field.name for field in fields(GridEvidence)]
    for shows, what in ((True, "grids"), (False, "other lattices")):
        print(
            f"{len(seen[shows])} {what}; | implausibility |", " | ".join(names), "| image |, in scales of the evidence"
        )
        for name, evidence in sorted(seen[shows], key=lambda item: item[1].implausibility, reverse=shows)[:SHOWN]:
            parts = (value / scale for value, scale in zip(astuple(evidence), SCALES, strict=True))
            print(f"| {evidence.implausibility:.2f} |", " | ".join(f"{part:.2f}" for part in parts), f"| {name} |")
    print(f"the limit is {MAX_IMPLAUSIBILITY}")
