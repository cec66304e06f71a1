"""Fast replacements of numpy functions agree with numpy."""

from __future__ import annotations

import numpy as np
import pytest

from rigkit.core.arrays import known_median, median_of, quantiles_of, scaled_pinv, symmetric_pinv


@pytest.mark.parametrize("count", [1, 2, 7, 100])
def test_medians_and_quantiles(count: int, rng: np.random.Generator) -> None:
    values = rng.normal(size=count)
    shares = [0.0, 0.05, 0.5, 0.9, 1.0]
    assert quantiles_of(values, shares) == pytest.approx(np.quantile(values, shares), rel=1e-12)
    assert median_of(values.copy()) == np.median(values)
    values[:: count + 3] = np.nan
    board = np.concatenate([values, rng.normal(size=3)]).reshape(-1, 1)
    assert known_median(board) == np.nanmedian(board)


def test_no_known_number_has_no_median() -> None:
    assert np.isnan(known_median(np.full((2, 3), np.nan)))


@pytest.mark.parametrize("rank", [0, 2, 5])
def test_pseudo_inverse_of_a_symmetric_matrix(rank: int, rng: np.random.Generator) -> None:
    root = rng.normal(size=(5, rank))
    matrix = root @ root.T
    assert symmetric_pinv(matrix, 1e-12) == pytest.approx(np.linalg.pinv(matrix, 1e-12, hermitian=True), rel=1e-9)


def test_pseudo_inverse_of_unknowns_with_units_of_their_own(rng: np.random.Generator) -> None:
    """Units change nothing but units, and what is not known at all stays so."""
    root, unit = rng.normal(size=(5, 7)), np.array([1e-9, 1.0, 1e6, 1e-3, 0.0])
    matrix = root @ root.T * unit[:, None] * unit
    expected = np.zeros((5, 5))
    expected[:4, :4] = np.linalg.inv((root @ root.T)[:4, :4]) / unit[:4, None] / unit[:4]
    found = scaled_pinv(matrix)
    assert found[:4, :4] == pytest.approx(expected[:4, :4], rel=1e-9)
    assert (found[4] == 0.0).all() and (found[:, 4] == 0.0).all()
