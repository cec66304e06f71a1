"""The searches of one image for lattices."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from rigkit.detection.lattice.lattice import Lattice
from rigkit.detection.lattices import _have_same_corners


def test_lattices_of_the_same_corners_are_fitted_once(rng: np.random.Generator) -> None:
    pixels = rng.uniform(0.0, 100.0, (4, 5, 2))
    pixels[0, 0] = np.nan
    one, two = Lattice(pixels, np.ones((4, 5)), True), Lattice(pixels[:3] + 200.0, np.ones((3, 5)), True)
    assert _have_same_corners([one, two], [one.turned(1), two.turned(2)])
    assert not _have_same_corners([one, two], [one])
    moved = pixels.copy()
    moved[2, 2] += 1e-9
    assert not _have_same_corners([one, two], [replace(one, pixels=moved), two])
