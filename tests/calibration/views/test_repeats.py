"""Repeated images are found, whatever their number."""

from __future__ import annotations

import numpy as np
import pytest

import rigkit.kernels.coverage as kernel
from rigkit.calibration.views.repeats import close_pairs
from rigkit.core.arrays import FloatArray


@pytest.mark.parametrize("count", [1, 2, 300, 1100])
@pytest.mark.parametrize("room", [0, 2])
def test_close_pairs_are_those_of_all_with_all(
    count: int, room: int, rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(kernel, "TYPICAL_PARTNERS", room)
    points: FloatArray = rng.integers(0, 40, (count, 3)).astype(np.float64) * 0.25
    apart = np.abs(points[:, None] - points).max(axis=2)
    expected = np.argwhere(np.triu(apart <= 0.5, 1))
    found = np.stack(close_pairs(points, 0.5), axis=1)
    assert count < 300 or len(expected) > 50
    assert np.array_equal(found[np.lexsort(found.T[::-1])], expected)
