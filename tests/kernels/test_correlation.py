"""The kernel of correlation.c against its definition in numpy, on numbers drawn at random."""

from __future__ import annotations

import numpy as np
import pytest
from kernels.reference import correlation as reference

from rigkit.detection.subpixel.correlation import factor_rules
from rigkit.kernels.edges import LAGS, NoiseOfCorners, sigma_factors, uneven_factors

ROUNDING = 1e-9
"""Both solve 13 equations in double precision."""


@pytest.mark.parametrize("shared", [0.0, 0.3, 0.8])
def test_factors_are_those_of_numpy(shared: float, rng: np.random.Generator) -> None:
    """Boards of many corners, of one and of none; some corners failed, others have a hand in their windows."""
    count, boards = 120, 6
    owner = np.where(rng.random(count) < 0.2, 3, rng.integers(0, 3, count))
    owner[0] = 5
    noise = rng.uniform(1.0, 3.0, count)
    noise[rng.random(count) < 0.1] *= 10.0
    fall = np.array([shared ** np.hypot(*lag) if shared else float(lag == (0, 0)) for lag in LAGS])
    pairs = np.round(rng.uniform(40.0, 300.0, (count, 1)) * rng.uniform(0.5, 1.0, (count, len(LAGS))))
    products = (noise**2)[:, None] * pairs * (fall + rng.normal(0.0, 0.05, pairs.shape))
    pairs[rng.random(count) < 0.1] = 0.0
    pairs[0] = 200.0
    pixels, sides = rng.uniform(0.0, 500.0, (count, 2)), rng.normal(0.0, 20.0, (count, 2, 2))
    blur, used, good = rng.uniform(0.2, 2.0, count), rng.uniform(30.0, 900.0, count), rng.random(count) < 0.9
    good[0] = True
    products[~good], pixels[~good], noise[~good] = np.nan, np.nan, np.nan
    corners, rules = NoiseOfCorners(products, pairs, noise, pixels, sides, blur, used, good, owner), factor_rules(18.0)
    ours, theirs = sigma_factors(corners, boards, rules), reference.sigma_factors(corners, boards, rules)
    assert theirs[4] == 1.0
    assert not shared or np.count_nonzero(theirs != 1.0) >= 3
    assert np.abs(ours / theirs - 1.0).max() < ROUNDING
    # Corners with so much more beside them than their boards that they have a factor of their own.
    products[::7, 1:] = (noise[::7] ** 2)[:, None] * pairs[::7, 1:]
    mine, yours = uneven_factors(corners, theirs, rules), reference.uneven_factors(corners, theirs, rules)
    assert 3 <= np.count_nonzero(yours != 1.0) < count
    assert np.abs(mine / yours - 1.0).max() < ROUNDING
