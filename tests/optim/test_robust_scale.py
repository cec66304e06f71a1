"""Medians of Gaussian noise against the distributions of scipy."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from rigkit.optim.robust_scale import (
    MEDIAN_OF_CHI_SQUARE_3,
    MEDIAN_OF_NORMAL,
    MEDIAN_OF_RAYLEIGH,
    SIGMA_OF_MEDIAN,
    robust_sigma,
)


def test_factors_are_medians_of_the_distributions() -> None:
    assert pytest.approx(stats.halfnorm.median(), abs=5e-5) == MEDIAN_OF_NORMAL
    assert pytest.approx(1.0 / stats.halfnorm.median(), abs=5e-5) == SIGMA_OF_MEDIAN
    assert pytest.approx(stats.rayleigh.median(), abs=5e-6) == MEDIAN_OF_RAYLEIGH
    assert pytest.approx(stats.chi2(3).median(), abs=5e-4) == MEDIAN_OF_CHI_SQUARE_3


def test_a_minority_of_outliers_hardly_changes_the_standard_deviation() -> None:
    places = stats.norm(0.0, 0.3).ppf((np.arange(1001) + 0.5) / 1001)
    assert robust_sigma(places) == pytest.approx(0.3, rel=0.01)
    assert robust_sigma(np.append(places, np.full(50, 1e6))) == pytest.approx(0.3, rel=0.1)
    assert np.isnan(robust_sigma(np.zeros(0)))
