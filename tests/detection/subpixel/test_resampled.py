"""Affinely resampled parts of an image."""

from __future__ import annotations

import numpy as np
import pytest

from rigkit.detection.lattice.lattice import Lattice
from rigkit.detection.subpixel import resampled as module


def test_boards_that_need_too_many_samples_are_sampled_more_coarsely(monkeypatch: pytest.MonkeyPatch) -> None:
    # Blurred boards in images of 48 megapixels; left in the image, their corners are off by several pixels.
    v, u = np.mgrid[:800, :1000]
    image = (40.0 + 0.1 * u + 0.05 * v).clip(0, 255).astype(np.float32)
    rows, columns = np.mgrid[:4, :5]
    pixels = np.stack([300.0 + 90.0 * columns, 300.0 + 80.0 * rows], axis=-1)
    lattice = Lattice(pixels, np.full((4, 5), 100.0), True)
    matrix = np.diag([0.1, 0.05])
    whole = module.resampled(image, lattice, matrix, 18.0)
    assert whole is not None
    monkeypatch.setattr(module, "MAX_RESAMPLED", 10.0 * whole.grey.size)
    part = module.resampled(image, lattice, matrix, 18.0)
    assert part is not None and part.grey.shape == whole.grey.shape
    u, v = part.of(lattice.pixels).reshape(-1, 2).round().astype(int).T
    expected = np.array([40.0, 0.0]) @ [1, 0] + part.back(np.column_stack([u, v]).astype(float)) @ [0.1, 0.05]
    assert np.abs(part.grey[v, u] - expected).max() < 0.1
    monkeypatch.setattr(module, "MAX_RESAMPLED", 0.5 * whole.grey.size)
    assert module.resampled(image, lattice, matrix, 18.0) is None
