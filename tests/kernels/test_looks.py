"""The sparse looks at an image of looks.c against numpy."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from kernels.reference import looks as reference
from numpy.typing import NDArray

from rigkit.kernels import front


@pytest.mark.parametrize("dtype", [np.uint8, np.float32])
@pytest.mark.parametrize("step", [1, 3])
def test_ratios_within_squares(step: int, dtype: type, rng: np.random.Generator) -> None:
    image: NDArray[Any] = rng.uniform(0.0, 255.0, (61, 84)).astype(dtype)
    image[1::2, ::2] = 0.7 * image[1::2, ::2]
    for one in (image, np.asarray(255 - image, dtype), np.roll(image, 1)):
        most = float(np.abs(reference.square_ratios(one, step, 12.0) - 1.0).max())
        assert most > 0.01
        # The median itself, and what is hardly more and hardly less.
        for share in (0.0, 0.5 * most, most - 1e-12, most, most + 1e-12, 2.0 * most):
            assert front.has_mosaic(one, step, 12.0, share) == reference.has_mosaic(one, step, 12.0, share)
            assert front.has_mosaic(one, step, 12.0, share) == (share <= most)
    assert not front.has_mosaic(np.minimum(image, dtype(9)), step, 12.0, 0.0)


@pytest.mark.parametrize("dtype", [np.uint8, np.float32])
def test_bad_pixels_are_counted(dtype: type, rng: np.random.Generator) -> None:
    image: NDArray[Any] = rng.uniform(100.0, 130.0, (70, 90)).astype(dtype)
    image[rng.random(image.shape) < 0.03] = 250
    image[rng.random(image.shape) < 0.03] = 0
    for first, apart, step, share in ((1, 3, 0.0, 0.15), (2, 5, 60.0, 0.0), (1, 1, 200.0, 0.0)):
        ours = front.bad_pixels(image, first, apart, step, share)
        assert ours == reference.bad_pixels(image, first, apart, step, share)
        assert (ours[0] > 20) == (step < 200.0)


@pytest.mark.parametrize("dtype", [np.uint8, np.float32])
@pytest.mark.parametrize("size", [(32, 40), (83, 121)])
def test_lines_that_alternate_are_counted(size: tuple[int, int], dtype: type, rng: np.random.Generator) -> None:
    image: NDArray[Any] = rng.integers(100, 130, size).astype(dtype)
    image[1::2, size[1] // 2 :] += dtype(40)
    for groups, step in ((8, 0.0), (size[0] // 4 // 8 * 8, 32.0)):
        ours, theirs = (way.alternating(image, groups, 8, step) for way in (front, reference))
        for one, other in zip(ours, theirs, strict=True):
            assert np.array_equal(one, other) and one.any()
