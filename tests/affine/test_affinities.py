"""Epipolar normals, direction noise and affinities as data."""

from __future__ import annotations

import numpy as np
import pytest

from rigkit.affine.affinities import Affinities, DirectionNoise, EpipolarNormals
from rigkit.core.errors import InputError
from rigkit.core.matches import DirectionPairs


def test_noise_of_a_board_recovers_what_edges_share(rng: np.random.Generator) -> None:
    """From the three 2x2 covariances of h, v and h + v follows the joint covariance, if cov(h, v) is symmetric."""
    half = rng.normal(size=(5, 4, 4))
    edges = half @ np.swapaxes(half, 1, 2)
    shared = 0.5 * (edges[:, :2, 2:] + edges[:, 2:, :2])
    edges[:, :2, 2:] = edges[:, 2:, :2] = shared
    joint = np.array([[1.0, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1], [1, 0, 1, 0], [0, 1, 0, 1]])
    full = joint @ edges @ joint.T
    blocks = np.stack([full[:, 2 * k : 2 * k + 2, 2 * k : 2 * k + 2] for k in range(3)], axis=1)
    noise = DirectionNoise.of_board(blocks, 2.0 * blocks)
    np.testing.assert_allclose(noise.covariance1, full, atol=1e-12)
    np.testing.assert_allclose(noise.covariance2, 2.0 * full, atol=1e-12)


def test_angular_noise_is_across_and_as_long_as_the_direction() -> None:
    pairs = DirectionPairs(
        image1=np.array([[[3.0, 4.0]]]),
        image2=np.array([[[0.0, -2.0]]]),
        valid=np.ones((1, 1), bool),
        scaled=True,
        kinds=("h",),
    )
    noise = DirectionNoise.angular(pairs, 0.1, 0.2)
    np.testing.assert_allclose(noise.covariance1[0], 0.01 * np.array([[16.0, -12.0], [-12.0, 9.0]]))
    np.testing.assert_allclose(noise.covariance2[0], 0.04 * np.array([[4.0, 0.0], [0.0, 0.0]]), atol=1e-18)


def test_isotropic_noise_takes_a_sigma_for_each(rng: np.random.Generator) -> None:
    d = rng.normal(size=(4, 3, 2))
    pairs = DirectionPairs(image1=d, image2=d, valid=np.ones((4, 3), dtype=bool))
    sigma = rng.uniform(0.1, 1.0, (4, 3))
    noise = DirectionNoise.isotropic(pairs, sigma, 0.5)
    np.testing.assert_allclose(np.diagonal(noise.covariance1, axis1=1, axis2=2), np.repeat(sigma**2, 2, axis=1))
    np.testing.assert_allclose(noise.covariance2, np.broadcast_to(0.25 * np.eye(6), (4, 6, 6)))


def test_shapes_are_checked() -> None:
    with pytest.raises(InputError, match="epipolar normals in image 2"):
        EpipolarNormals(np.zeros((4, 2)), np.zeros((3, 2)))
    with pytest.raises(InputError, match="Nx2Kx2K"):
        DirectionNoise(np.zeros((4, 3, 3)), np.zeros((4, 3, 3)))
    with pytest.raises(InputError, match="NxKx2x2"):
        DirectionNoise.independent(np.zeros((4, 4)), np.zeros((4, 4)))
    with pytest.raises(InputError, match="Nx3x2x2"):
        DirectionNoise.of_board(np.zeros((4, 2, 2, 2)), np.zeros((4, 2, 2, 2)))


def test_sigma_is_the_rms_of_the_entries() -> None:
    covariance = np.diag([1.0, 4.0, 9.0, 2.0])[None]
    found = Affinities(np.zeros((1, 2, 2)), np.ones(1, bool), np.ones(1), covariance)
    assert found.sigma_A is not None
    assert found.sigma_A[0] == pytest.approx(2.0)
    assert Affinities(np.zeros((1, 2, 2)), np.ones(1, bool), np.ones(1)).sigma_A is None
