"""Corners whose fit determines no position are not reported."""

from __future__ import annotations

import numpy as np

from rigkit.detection.lattice.lattice import Lattice
from rigkit.detection.subpixel.consistent import LOCATED_CELLS, without_uncertain
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
