"""Estimators for any mix of directions with and without lengths: exact, and equal to those of the registry."""

from __future__ import annotations

import numpy as np
import pytest
from helpers.affine_scenes import Corners, general_pairs, turned

from rigkit.affine.affinities import DirectionNoise
from rigkit.affine.mixed import affines_from_mixed_directions
from rigkit.affine.registry import affines_from_directions
from rigkit.core.errors import InputError
from rigkit.core.matches import DirectionPairs

MC_RELATIVE = 0.12
"""Second moments of 4000 trials, first order."""


@pytest.fixture(scope="module")
def corners() -> Corners:
    return general_pairs(np.random.default_rng(21), 4, (40.0, 70.0))


def lengths_lost(directions: DirectionPairs, scaled: list[bool], rng: np.random.Generator) -> DirectionPairs:
    """Stretch the directions whose length shall not count, so that it cannot be used by mistake."""
    factor = np.where(scaled, 1.0, rng.uniform(0.2, 5.0, directions.valid.shape))[..., None]
    return DirectionPairs(
        image1=directions.image1,
        image2=directions.image2 * factor,
        valid=directions.valid,
        scaled=False,
        kinds=directions.kinds,
    )


@pytest.mark.parametrize(
    ("scaled", "with_epipolar"),
    [
        ([True, True, True], False),
        ([True, False, False], False),
        ([False, True, True], False),
        ([False, False, False], True),
        ([True, False, False], True),
        ([False, False, True], True),
    ],
)
def test_exact(scaled: list[bool], with_epipolar: bool, corners: Corners, rng: np.random.Generator) -> None:
    directions = lengths_lost(corners.directions(), scaled, rng)
    epipolar = corners.epipolar if with_epipolar else None
    found = affines_from_mixed_directions(directions, np.array(scaled), epipolar=epipolar)
    assert found.valid.mean() > 0.95
    np.testing.assert_allclose(found.A21[found.valid], corners.A21[found.valid], rtol=1e-7, atol=1e-9)


def test_one_direction_with_length_and_the_epipolar_geometry(corners: Corners) -> None:
    """One direction is not enough: along the other axis nothing is known."""
    one = DirectionPairs(
        image1=corners.exact1[:, :1],
        image2=corners.exact2[:, :1],
        valid=np.ones((len(corners), 1), bool),
        scaled=True,
        kinds=("h",),
    )
    assert not affines_from_mixed_directions(one, np.array(True), epipolar=corners.epipolar).valid.any()


@pytest.mark.parametrize(
    ("scaled", "with_epipolar", "count"),
    [([False, False, False], False, 0), ([True, False, False], False, 0), ([False] * 3, True, 2)],
)
def test_too_few_equations(scaled: list[bool], with_epipolar: bool, count: int, corners: Corners) -> None:
    """Three without length are three equations for four unknowns; two, one with length, are three as well."""
    directions = corners.directions()
    valid = directions.valid.copy()
    if any(scaled) or with_epipolar:
        valid[:, 2] = False
    some = DirectionPairs(image1=directions.image1, image2=directions.image2, valid=valid)
    epipolar = corners.epipolar if with_epipolar else None
    found = affines_from_mixed_directions(some, np.array(scaled), epipolar=epipolar)
    assert found.valid.any() == (count == 2)


def test_without_lengths_it_is_f3udir(corners: Corners, rng: np.random.Generator) -> None:
    noisy = turned(corners.directions(), 3.0, rng)
    found = affines_from_mixed_directions(noisy, np.array(False), epipolar=corners.epipolar)
    expected = affines_from_directions(noisy, "F3UDIR", epipolar=corners.epipolar)
    np.testing.assert_allclose(found.conditioning, expected.conditioning, rtol=1e-5)
    np.testing.assert_allclose(found.A21[found.valid], expected.A21[found.valid], rtol=1e-6, atol=1e-9)


def test_two_with_lengths_are_2sdir(corners: Corners, rng: np.random.Generator) -> None:
    noisy = turned(corners.directions(), 3.0, rng)
    two = DirectionPairs(
        image1=noisy.image1[:, :2], image2=noisy.image2[:, :2], valid=noisy.valid[:, :2], scaled=True, kinds=("h", "v")
    )
    found = affines_from_mixed_directions(two, np.array(True))
    np.testing.assert_allclose(found.A21, affines_from_directions(two, "2SDIR").A21, rtol=1e-8)


@pytest.mark.parametrize(("scaled", "with_epipolar"), [([True, False, False], False), ([True, False, True], True)])
def test_predicted_covariance(
    scaled: list[bool], with_epipolar: bool, corners: Corners, rng: np.random.Generator
) -> None:
    one = corners.select(np.array([70]))
    noise = DirectionNoise.isotropic(one.directions(), 0.1, 0.07)
    predicted = affines_from_mixed_directions(
        one.directions(), np.array(scaled), epipolar=one.epipolar if with_epipolar else None, noise=noise
    )
    many = corners.select(np.full(4000, 70))
    images = [e + s * rng.normal(size=e.shape) for e, s in ((many.exact1, 0.1), (many.exact2, 0.07))]
    noisy = lengths_lost(
        DirectionPairs(image1=images[0], image2=images[1], valid=np.ones((4000, 3), dtype=bool)), scaled, rng
    )
    sample = affines_from_mixed_directions(
        noisy, np.array(scaled), epipolar=many.epipolar if with_epipolar else None, min_conditioning=0.0
    )
    measured = np.cov(sample.A21.reshape(-1, 4).T)
    assert predicted.covariance is not None
    assert np.abs(predicted.covariance[0] - measured).max() < MC_RELATIVE * np.trace(measured)


def test_misuse(corners: Corners) -> None:
    with pytest.raises(InputError, match="broadcast"):
        affines_from_mixed_directions(corners.directions(), np.ones(5, dtype=bool))
    with pytest.raises(InputError, match="epipolar normals of 3"):
        some = corners.select(np.arange(3))
        affines_from_mixed_directions(corners.directions(), np.array(True), epipolar=some.epipolar)
