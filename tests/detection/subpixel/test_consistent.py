"""Corners whose fit determines no position, or contradicts the others, are not reported."""

from __future__ import annotations

import numpy as np
import pytest

from rigkit.detection.lattice.lattice import Lattice
from rigkit.detection.subpixel.consistent import LOCATED_CELLS, without_inconsistent, without_uncertain
from rigkit.detection.subpixel.refined import RefinedLattice


def test_corners_less_certain_than_a_part_of_their_cell_are_dropped() -> None:
    v, u = np.mgrid[:4, :5] * 20.0
    every = np.ones((4, 5))
    lattice = Lattice(np.stack([u, v], axis=-1), 100.0 * every, True)
    sigma_px = 0.1 * every
    certain = RefinedLattice(lattice, sigma_px, every, every, every)
    assert without_uncertain(certain) is certain
    sigma_px[1, 2], sigma_px[3, 4] = 1.01 * LOCATED_CELLS * 20.0, 0.99 * LOCATED_CELLS * 20.0
    left = without_uncertain(RefinedLattice(lattice, sigma_px, every, every, every))
    assert np.argwhere(~left.lattice.known).tolist() == [[1, 2]]
    assert np.isnan(left.sigma_px[1, 2])


@pytest.mark.parametrize("bent", [0.0, 0.005])
def test_the_last_corner_of_two_rows_is_in_line_with_them(bent: float) -> None:
    """In heat images the corner of a board moves where its last square is as cold as the paper. `bent`: a wide lens."""
    v, u = np.mgrid[:6, :8] - np.array([2.5, 3.5])[:, None, None]
    shrunk = 20.0 / (1.0 + bent * (u * u + v * v))
    every = np.ones((6, 8))
    pixels = np.stack([u * shrunk, v * shrunk], axis=-1) + np.random.default_rng(0).normal(0.0, 0.1, (6, 8, 2))
    sigma_px = 0.1 * every

    def kept(off_px: float, sigma: float) -> bool:
        moved, stated = pixels.copy(), sigma_px.copy()
        moved[0, 0] += off_px
        stated[0, 0] = sigma
        item = RefinedLattice(Lattice(moved, 100.0 * every, True), stated, every, every, every)
        left = without_inconsistent(item, [(slice(None), slice(None))]).lattice.known
        assert np.count_nonzero(~left) <= (not left[0, 0])
        return bool(left[0, 0])

    assert kept(0.0, 0.1)
    assert kept(0.6, 0.3)
    assert not kept(4.0, 0.5)


def test_the_bend_of_a_strong_lens_displaces_no_corner() -> None:
    v, u = np.mgrid[:6, :8].astype(float)
    # At the rim of a fisheye squares shrink ever faster.
    bend = 15.0 * np.exp(-0.5 * (u + v))
    pixels = np.stack([20.0 * u + bend, 20.0 * v + bend], axis=-1)
    pixels += np.random.default_rng(0).normal(0.0, 0.02, pixels.shape)
    every = np.ones((6, 8))
    item = RefinedLattice(Lattice(pixels, 100.0 * every, True), 0.05 * every, every, every, every)
    assert without_inconsistent(item, [(slice(None), slice(None))]) is item
