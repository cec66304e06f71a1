"""Variances of small samples, pooled as far as they differ by chance alone."""

from __future__ import annotations

import numpy as np

from rigkit.optim.local_variances import of_redescending, shrunk_variances

FREEDOM = 8.0
TURN = 2.385


def sample_variances(rng: np.random.Generator, true: np.ndarray) -> np.ndarray:
    return true * rng.chisquare(FREEDOM, len(true)) / FREEDOM


def test_samples_of_one_variance_get_that_one(rng: np.random.Generator) -> None:
    found = shrunk_variances(sample_variances(rng, np.full(4000, 3.0)), np.full(4000, FREEDOM))
    # A sample of eight degrees scatters by a half.
    assert np.abs(found / 3.0 - 1.0).max() < 0.15


def test_samples_that_differ_keep_their_own(rng: np.random.Generator) -> None:
    true = np.repeat([1.0, 25.0], [3000, 1000])
    found = shrunk_variances(sample_variances(rng, true), np.full(4000, FREEDOM))
    quiet, noisy = found[:3000], found[3000:]
    assert 0.8 < np.median(quiet) < 1.6
    assert 15.0 < np.median(noisy) < 30.0


def test_errors_over_the_sigmas_hold_where_variances_are_drawn_from_the_assumed_distribution(
    rng: np.random.Generator,
) -> None:
    true = 2.0 * 5.0 / rng.chisquare(5.0, 20000)
    found = shrunk_variances(sample_variances(rng, true), np.full(20000, FREEDOM))
    errors = np.sqrt(true) * rng.normal(size=20000)
    # Student's t of 13 degrees; 20000 tell a share to 0.3 %.
    assert abs(np.mean(np.abs(errors) < np.sqrt(found)) - 0.664) < 0.02
    assert abs(np.mean(np.abs(errors) < 2.0 * np.sqrt(found)) - 0.933) < 0.01


def test_a_sample_without_scatter_gets_what_is_common(rng: np.random.Generator) -> None:
    true = 2.0 * 5.0 / rng.chisquare(5.0, 1000)
    variances = sample_variances(rng, true)
    variances[0] = 0.0
    found = shrunk_variances(variances, np.full(1000, FREEDOM))
    assert 0.1 < found[0] < found[variances > np.median(variances)].min()


def test_one_sample_stays_as_it_is() -> None:
    np.testing.assert_array_equal(shrunk_variances(np.array([2.0]), np.array([FREEDOM])), [2.0])


def test_what_a_redescending_loss_leaves_is_made_whole(rng: np.random.Generator) -> None:
    for variance in (0.25, 1.0, 4.0, 16.0):
        square = variance * rng.chisquare(3, 200_000)
        weight = 1.0 / (1.0 + square / (3.0 * TURN**2)) ** 2
        left = np.sum(weight * square) / (3.0 * np.sum(weight))
        assert left < variance
        # 200 000 draws tell a variance to 0.3 %, and less where weights are small.
        assert abs(float(of_redescending(np.array(left), TURN)) / variance - 1.0) < 0.03


def test_samples_of_equal_variances_stay() -> None:
    np.testing.assert_allclose(shrunk_variances(np.full(5, 4.0), np.full(5, 1e6)), 4.0, rtol=1e-5)
