"""Images that repeat each other: the same boards at the same places are one measurement, not two."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from rigkit.core.arrays import FloatArray, IntArray, Pixels

REPEATED_PX = 0.5
"""Boards whose corners have, in two images, the same centre and the same extents within this were not moved between."""
PAIRS_AT_A_TIME = 2**18
"""Keeps the memory small."""
MAX_ALONG_ONE_AXIS = 1024
"""So many points at most are sorted along one axis; more of them along two."""
MIN_STRIP = 1e-6
"""No strip is narrower than this part of the whole: places along strips are then exact to 1e-10 of it."""
SOUGHT_FURTHER = 1.001
"""Pairs are sought this far, for rounding, and kept by their own distances."""


def cluster_numbers(images: Sequence[str], boards: Sequence[str], pixels: Sequence[Pixels]) -> IntArray:
    """Return for each view (V,) the number of the image that it is of; images that repeat an earlier one have its
    number.

    Parameters
    ----------
    images, boards : name of each view's image and of its board.
    pixels : (N, 2) of each view's corners.
    """
    places, shown = _places(pixels), dict[str, list[int]]()
    for view, image in enumerate(images):
        shown.setdefault(image, []).append(view)
    # Only images of the same boards can repeat each other.
    alike: dict[tuple[str, ...], list[list[int]]] = {}
    for own in shown.values():
        if len(own) > 1:
            own.sort(key=lambda view: (boards[view], places[view].tolist()))
        alike.setdefault(tuple(boards[view] for view in own), []).append(own)
    number = {image: i for i, image in enumerate(shown)}
    for group in alike.values():
        one, other = close_pairs(places[np.array(group)].reshape(len(group), -1), REPEATED_PX)
        for earlier, later in sorted(zip(one.tolist(), other.tolist(), strict=True), key=lambda pair: pair[::-1]):
            names = images[group[earlier][0]], images[group[later][0]]
            number[names[1]] = min(number[names[0]], number[names[1]])
    _, dense = np.unique([number[name] for name in images], return_inverse=True)
    return dense.astype(np.int64)


def close_pairs(points: FloatArray, reach: float) -> tuple[IntArray, IntArray]:
    """Return which of the points (N, D), D > 1, are within `reach` of each other along every axis: i < j, (P,) each."""
    extent = np.ptp(points, axis=0)
    axes = np.argsort(extent, kind="stable")
    there, many = np.arange(len(points)), len(points) > MAX_ALONG_ONE_AXIS
    side = max(reach, MIN_STRIP * float(extent.max()), np.finfo(float).tiny)
    place, length = points[:, axes[-1]], 0.0
    if many:
        # In strips across the axis in which they are the furthest apart, one after the other along the next one: close
        # ones are in the same strip or in the next.
        strip, along = (place - place.min()) // side, points[:, axes[-2]]
        length = float(extent[axes[-2]]) + 4.0 * side
        place = along - along.min() + strip * length
    order = np.argsort(place, kind="stable")
    place, ordered = place[order], points[order][:, axes].T.copy()
    runs = [(there + 1, np.searchsorted(place, place + SOUGHT_FURTHER * side, side="right"))]
    if many:
        ends = place + length - SOUGHT_FURTHER * side, place + length + SOUGHT_FURTHER * side
        runs.append((np.searchsorted(place, ends[0]), np.searchsorted(place, ends[1])))
    found = [np.zeros((2, 0), np.int64)]
    for begin, end in runs:
        ahead = end - begin
        for block in np.array_split(there, 1 + int(ahead.sum()) // PAIRS_AT_A_TIME):
            count = ahead[block]
            first = np.repeat(block, count)
            second = np.arange(len(first)) + np.repeat(begin[block] - np.cumsum(count) + count, count)
            # The widest axis but the one that they are sorted along tells the most of them apart.
            for values in np.roll(ordered[::-1], -1, axis=0):
                close = np.abs(values[first] - values[second]) <= reach
                first, second = first[close], second[close]
                if not len(first):
                    break
            found.append(order[np.stack([first, second])])
    pairs = np.sort(np.concatenate(found, axis=1), axis=0)
    return pairs[0], pairs[1]


def _places(pixels: Sequence[Pixels]) -> FloatArray:
    """Return for each view how many corners there are, their centre, and their extents along the image's axes and
    diagonals, px: (V, 7)."""
    count = np.array([len(corners) for corners in pixels])
    start, corners = np.cumsum(count) - count, np.concatenate([np.asarray(one) for one in pixels])
    along = np.array([[1.0, 0.0], [0.0, 1.0], [1.0, 1.0], [1.0, -1.0]]) @ corners.T
    centre = np.add.reduceat(along[:2], start, axis=1) / count
    extents = np.maximum.reduceat(along, start, axis=1) - np.minimum.reduceat(along, start, axis=1)
    return np.concatenate([count[None], centre, extents]).T
