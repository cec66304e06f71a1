"""Boards half of which something covers: what is seen of them is found, and nothing else is claimed."""

from __future__ import annotations

from itertools import product

import numpy as np
import pytest
from detection_bench.scenes import one_board
from measure_covers import Score, cover, laid_over, scored

from rigkit.core.boards import Board
from rigkit.detection.detect import detect_boards
from rigkit.detection.lattice.local_fit import fit_cells

BOARD = Board("b", 8, 6, 30.0, 30.0)
SEEDS = 6

MAX_OF_IT = 0.75
"""Of the corners in view: of 36 boards 0.8 are found."""


def covered(seed: int, lens: str, kind: str) -> Score:
    """Return what is found of a board half of which is covered."""
    rng = np.random.default_rng(seed)
    scene = one_board(rng, lens=lens, board=BOARD)
    image = np.asarray(scene.render(rng=rng, blur_px=0.7, noise_levels=2.0), np.uint8)
    (truth,) = scene.truth()
    sides = fit_cells(truth.lattice(), np.isfinite(truth.lattice()[..., 0])).cell_px()
    mask = cover(image, truth.pixels, float(np.median(sides)), kind, 0.5, rng)
    return scored(list(detect_boards(laid_over(image, mask, kind, rng), [BOARD])), truth.pixels, sides, mask)


def test_what_is_seen_of_covered_boards_is_found_and_nothing_else() -> None:
    total = Score()
    for lens, kind, seed in product(("regular", "fisheye"), ("flat", "texture", "hand"), range(SEEDS)):
        total.add(covered(seed, lens, kind))
    assert total.false == 0
    assert total.images == 6 * SEEDS
    assert total.found > MAX_OF_IT * total.in_view


@pytest.mark.parametrize(("seed", "lens"), [(18, "fisheye"), (44, "fisheye"), (51, "regular")])
def test_corners_with_something_else_in_their_windows_are_not_claimed(seed: int, lens: str) -> None:
    """Of 240 such boards five had a false corner."""
    assert covered(seed, lens, "texture").false == 0
