"""Correspondences with the images exchanged, and as matches of two cameras."""

from __future__ import annotations

import numpy as np

from rigkit.affine.correspondences import Correspondences
from rigkit.cameras.brown import Brown
from rigkit.cameras.pinhole import Pinhole

SIZE = (640, 480)


def test_exchanged_affinities_are_inverses_with_their_sigma(rng: np.random.Generator) -> None:
    pixels1, pixels2 = rng.uniform(0.0, 400.0, (2, 7, 2))
    A21, sigma_A = rng.normal(size=(7, 2, 2)), rng.uniform(0.01, 0.02, 7)
    # Turned and scaled alike along all directions: the errors of all entries are then scaled alike.
    A21[0] = [[1.2, -1.6], [1.6, 1.2]]
    back = Correspondences(pixels1, pixels2, A21, sigma_A=sigma_A).exchanged()
    assert back.A21 is not None and back.sigma_A is not None
    np.testing.assert_allclose(back.A21, np.linalg.inv(A21), rtol=1e-12)
    np.testing.assert_array_equal(back.pixels1, pixels2)
    np.testing.assert_array_equal(back.pixels2, pixels1)
    step = 1e-6 * rng.normal(size=(10000, 2, 2))
    spread = np.std(np.linalg.inv(A21[0] + step) - back.A21[0]) / 1e-6
    np.testing.assert_allclose(back.sigma_A[0], spread * sigma_A[0], rtol=0.02)
    plain = Correspondences(pixels1, pixels2).exchanged()
    assert plain.A21 is None and (plain.pixels1 == pixels2).all()


def test_points_that_one_camera_does_not_see_are_no_matches() -> None:
    wide = Pinhole(SIZE, np.array([500.0, 500.0, 320.0, 240.0]))
    # Its image folds before the border.
    folding = Brown(SIZE, np.array([500.0, 500.0, 320.0, 240.0, -0.9, 0.0, 0.0, 0.0]))
    places = np.array([[320.0, 240.0], [639.0, 479.0], [330.0, 250.0]])
    kept = [True, False, True]
    for cameras in ((wide, folding), (folding, wide)):
        matches, seen = Correspondences(places, places, sigma_px=np.array([0.1, 0.2, 0.3])).matches(*cameras)
        assert seen.tolist() == kept
        np.testing.assert_array_equal(matches.pixels1, places[kept])
        np.testing.assert_array_equal(matches.sigma1_px, [0.1, 0.3])
