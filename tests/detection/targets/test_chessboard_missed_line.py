"""Lattices that lack one row or column of a declared chessboard."""

from __future__ import annotations

import numpy as np
import pytest
from detection_bench.scenes import one_board

from rigkit.core.boards import Board
from rigkit.detection.detect import detect_boards
from rigkit.detection.lattice.lattice import Lattice
from rigkit.detection.saddles.response import grey_image
from rigkit.detection.subpixel.refined import RefinedLattice
from rigkit.detection.targets.chessboard import _with_missed_line

BOARD = Board("b", 9, 6, 30.0, 30.0)
WITHOUT = {
    "first row": (slice(1, None), slice(None)),
    "first column": (slice(None), slice(1, None)),
    "last row": (slice(None, -1), slice(None)),
    "last column": (slice(None), slice(None, -1)),
}
"""Parts of a board (rows, columns)."""


@pytest.mark.parametrize("missed", WITHOUT)
def test_a_missed_line_is_looked_for_on_both_sides(missed: str, rng: np.random.Generator) -> None:
    image = one_board(rng, board=BOARD, max_tilt_deg=20.0).render(noise_levels=2.0, rng=rng)
    (found,) = detect_boards(image, [BOARD])
    whole = found.lattice()
    part = whole[WITHOUT[missed]]
    one = np.ones(part.shape[:2])
    item = RefinedLattice(Lattice(part, 100.0 * one, True), 0.03 * one, one, one, one)
    placed = _with_missed_line(grey_image(image), item, [BOARD])
    assert placed is not None
    expected = np.full_like(whole, np.nan)
    expected[WITHOUT[missed]] = part
    assert np.array_equal(placed.lattice.pixels, expected, equal_nan=True)
