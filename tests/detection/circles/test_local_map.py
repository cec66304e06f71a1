"""The printed radius of circles, with single circles whose edges are elsewhere."""

from __future__ import annotations

import numpy as np
import pytest

from rigkit.core.arrays import FloatArray
from rigkit.detection.circles.local_map import PlaneMap, Radii

RADIUS = 0.3
"""In distances of neighbours."""


def slanted_circles(rng: np.random.Generator) -> tuple[FloatArray, PlaneMap]:
    """Return maps of circles on a slanted board, px per radius, with noise, and the maps of the lattice there."""
    count, slant_rad = 80, 0.3
    distance_px = 60.0 / np.linspace(0.9, 1.1, count)
    first = distance_px[:, None, None] * np.diag([1.0, np.cos(slant_rad)])
    every = np.ones(count, dtype=bool)
    around = PlaneMap(
        pixels=np.zeros((count, 2)),
        first=first,
        second=np.zeros((count, 2, 3)),
        support=np.full(count, 9),
        surrounded=every,
        gain=np.ones(count),
        slope_gain=np.ones(count),
    )
    return RADIUS * first + rng.normal(0.0, 0.02, first.shape), around


@pytest.mark.parametrize("moved_px", [0.0, 0.3])
def test_a_few_smeared_circles_leave_the_printed_radius(moved_px: float, rng: np.random.Generator) -> None:
    """Four of 80, a tenth too large at one end of the board, would turn the line to 0.346."""
    maps, around = slanted_circles(rng)
    maps += moved_px * np.eye(2)
    maps[:4] *= 1.1
    assert Radii.of(maps, around).printed == pytest.approx(RADIUS, rel=0.03)
