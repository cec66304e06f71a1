"""Sigmas of corners whose windows show edges that are not the board's."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from helpers.data import shared_data
from measure_covers import measured

from rigkit.detection.lattice.lattice import Lattice
from rigkit.detection.subpixel.refined import RefinedLattice
from rigkit.detection.subpixel.uncertain_corners import OF_ONE_EDGE, UNLIKE, sigmas_beside_edges
from rigkit.io.boards.board_words import board_of_words

LIFECAM = "charuco:7x7x25.4,dictionary=DICT_4X4_50,marker_mm=19.05"


def test_residuals_far_above_those_of_the_board_raise_sigmas() -> None:
    every = np.ones((4, 5))
    lattice = Lattice(np.stack(np.meshgrid(np.arange(5.0), np.arange(4.0)), axis=-1), 100.0 * every, True)
    residual = 2.0 * every
    residual[1, 2], residual[2, 2], residual[3, 4] = 60.0, 0.99 * UNLIKE * 2.0, np.nan
    lattice = lattice.without(np.isnan(residual))
    sigma_px = sigmas_beside_edges(RefinedLattice(lattice, 0.01 * every, every, residual, 2.0 * every))
    assert sigma_px[2, 2] == pytest.approx(0.01)
    # All of its residual is the edge's, and 30 times the noise.
    assert sigma_px[1, 2] == pytest.approx(0.3 * OF_ONE_EDGE, rel=0.01)
    assert np.count_nonzero(np.isclose(sigma_px, 0.01)) == 18 and np.isnan(sigma_px[3, 4])


def test_residuals_that_grow_towards_a_side_leave_sigmas() -> None:
    """At the rim of a fisheye image sigmas of squares seen obliquely are large already, and right."""
    every = np.ones((4, 9))
    lattice = Lattice(np.stack(np.meshgrid(np.arange(9.0), np.arange(4.0)), axis=-1), 100.0 * every, True)
    residual = np.array([2.0, 2.0, 2.0, 2.0, 2.0, 2.0, 4.0, 8.0, 16.0]) * every
    sigma_px = sigmas_beside_edges(RefinedLattice(lattice, 0.01 * every, every, residual, residual))
    np.testing.assert_array_equal(sigma_px, 0.01)


@pytest.mark.parametrize("taken", ["080508550", "080518213"])
def test_real_boards_with_markers_under_a_cover(taken: str) -> None:
    """Of these some corners at the edge of the cover were 8 sigmas off."""
    (path,) = shared_data("public/charuco-lifecam").glob(f"*T{taken}.jpg")
    scores = measured(Path(path), board_of_words(LIFECAM), ["flat", "texture"], 0.5)
    assert [(score.boards, score.far) for score in scores.values()] == [(1, 0), (1, 0)]
