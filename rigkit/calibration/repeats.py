"""Images that repeat each other: the same boards at the same places are one measurement, not two."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from rigkit.core.arrays import IntArray, Pixels

__all__ = ["cluster_numbers"]

REPEATED_PX = 0.5
"""Boards whose corners have, in two images, the same centre and the same extents within this were not moved between."""


def cluster_numbers(images: Sequence[str], boards: Sequence[str], pixels: Sequence[Pixels]) -> IntArray:
    """Return for each view (V,) the number of the image that it is of; images that repeat an earlier one have its
    number.

    Parameters
    ----------
    images, boards : name of each view's image and of its board.
    pixels : (N, 2) of each view's corners.
    """
    shown: dict[str, list[tuple[str, tuple[float, ...]]]] = {}
    for image, board, corners in zip(images, boards, pixels, strict=True):
        shown.setdefault(image, []).append((board, _place(corners)))
    names = list(shown)
    own = [sorted(shown[name]) for name in names]
    number: dict[str, int] = {}
    for i, name in enumerate(names):
        again = next((j for j in range(i) if _alike(own[i], own[j])), i)
        number[name] = number[names[again]] if again < i else i
    _, dense = np.unique([number[name] for name in images], return_inverse=True)
    return dense.astype(np.int64)


def _place(corners: Pixels) -> tuple[float, ...]:
    """Return how many corners there are, their centre, and their extents along the image's axes and diagonals, px."""
    along = corners @ np.array([[1.0, 0.0, 1.0, 1.0], [0.0, 1.0, 1.0, -1.0]])
    return (float(len(corners)), *corners.mean(axis=0).tolist(), *np.ptp(along, axis=0).tolist())


def _alike(one: list[tuple[str, tuple[float, ...]]], other: list[tuple[str, tuple[float, ...]]]) -> bool:
    return len(one) == len(other) and all(
        a == b and max(abs(x - y) for x, y in zip(p, q, strict=True)) <= REPEATED_PX
        for (a, p), (b, q) in zip(one, other, strict=True)
    )
