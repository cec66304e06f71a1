"""The kernel of splits.c against its definition in numpy: lattices of one board and of two that touch."""

from __future__ import annotations

import numpy as np
import pytest
from kernels.reference import discontinuity as reference

from rigkit.core.arrays import FloatArray
from rigkit.detection.checks.discontinuity import _rules
from rigkit.kernels.lattice import clearest_splits

ROUNDING = 1e-6
"""Relative: few columns leave combinations of terms open but for a ridge of 1e-9, and these take up rounding."""


@pytest.mark.parametrize("several", [False, True])
def test_splits_are_those_of_numpy(several: bool, rng: np.random.Generator) -> None:
    split = 0
    for _ in range(60):
        rows, columns = (int(count) for count in rng.integers(2, 15, 2))
        cells = np.stack(np.meshgrid(np.arange(columns), np.arange(rows)), axis=-1).astype(np.float64)
        pixels: FloatArray = cells * rng.uniform(8.0, 40.0)
        pixels += 2e-4 * (pixels - pixels.mean()) ** 2
        if rng.random() < 0.6:
            # Another board goes on where this one ends, turned and aside, and the other way round for rows.
            start = int(rng.integers(0, columns))
            pixels[:, start:] += rng.normal(0.0, 3.0, 2) + 0.02 * pixels[:, start:, ::-1] * (1.0, -1.0)
        if rng.random() < 0.5:
            pixels = np.ascontiguousarray(pixels.swapaxes(0, 1)[..., ::-1])
        sigma = rng.uniform(0.01, 0.1, pixels.shape[:2])
        pixels += sigma[..., None] * rng.normal(size=pixels.shape)
        missing = rng.random(sigma.shape) < rng.choice([0.0, 0.2])
        pixels[missing], sigma[missing] = np.nan, np.nan
        if not np.isfinite(pixels).any():
            continue
        ours = clearest_splits(pixels, sigma, several, _rules())
        views = (pixels, sigma), (pixels.swapaxes(0, 1), sigma.T)
        for (ratio, start, end), view in zip(ours, views, strict=True):
            theirs = reference.clearest_split(*view, several)
            assert (start, end) == (theirs.start, theirs.end)
            assert abs(ratio - theirs.ratio) <= ROUNDING * theirs.ratio
            split += ratio > 0.0
    assert split >= 15
