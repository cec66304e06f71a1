"""What the detector asks the kernels of looks.c for, in numpy; arguments as those of `rigkit.kernels.front`."""

from __future__ import annotations

import numpy as np

from rigkit.core.arrays import FloatArray, GreyImage, IntArray, upper_median


def square_ratios(image: GreyImage, step: int, least: float) -> FloatArray:
    """Return the upper medians (4,) of how bright the pixels of bright squares are beside the mean of their square."""
    down, across = (side // 2 // step for side in image.shape)
    places = [image[v::2, u::2][: down * step : step, : across * step : step] for v in (0, 1) for u in (0, 1)]
    values = np.stack([part.astype(np.float64).ravel() for part in places])
    mean = values.mean(axis=0)
    bright = mean > max(upper_median(mean), least)
    return np.array([upper_median(own[bright] / mean[bright]) for own in values]) if bright.any() else np.ones(4)


def has_mosaic(image: GreyImage, step: int, least: float, share: float) -> bool:
    return bool(np.abs(square_ratios(image, step, least) - 1.0).max() >= share)


def bad_pixels(image: GreyImage, first: int, apart: int, step: float, share: float) -> tuple[int, float]:
    values = image.astype(np.float64)
    rows = np.arange(first, len(image) - 1, apart)
    span = float(np.ptp(values[rows]))
    moved = [np.roll(values, (v, u), axis=(0, 1)) for v in (-1, 0, 1) for u in (-1, 0, 1) if v or u]
    beyond = np.maximum(values - np.max(moved, axis=0), np.min(moved, axis=0) - values)
    return int(np.count_nonzero(beyond[rows, 1:-1] > max(step, share * span))), span


def alternating(image: GreyImage, groups: int, tiles: int, step: float) -> tuple[IntArray, IntArray]:
    height, width = image.shape
    first = 2 * (np.arange(groups) * ((height - 4) // 2) // max(groups - 1, 1))
    one, two, three, four = (image[first + k].astype(np.float64) for k in range(4))
    across = width // tiles
    apart, between = (
        np.abs(part[:, : across * tiles]).reshape(tiles, groups // tiles, tiles, across)
        for part in (one - two + three - four, one + two - three - four)
    )
    more, less = apart > np.maximum(between, step), between > np.maximum(apart, step)
    return np.count_nonzero(more, axis=(1, 3)), np.count_nonzero(less, axis=(1, 3))
