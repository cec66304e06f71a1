"""Near-duplicate images: the same boards at the same places are one measurement, not two."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from rigkit.core.arrays import FloatArray, IntArray, Pixels
from rigkit.kernels.coverage import pairs_within

REPEATED_PX = 0.5
"""A board was not moved between two images if the centre and the extents of its corners are equal within this."""
MAX_ALONG_ONE_AXIS = 1024
"""Up to so many points are sorted along one axis; more of them along two."""
MIN_STRIP = 1e-6
"""Smallest width of a strip, as a part of the extent: positions along strips are then exact to 1e-10 of it."""
SEARCH_FACTOR = 1.001
"""Margin of the search for pairs, for rounding; their own distances decide."""


def cluster_numbers(images: Sequence[str], boards: Sequence[str], pixels: Sequence[Pixels]) -> IntArray:
    """Return for each view (V,) the cluster number of its image; near-duplicates, also by a chain of others, have the
    same number.

    Parameters
    ----------
    images, boards : name of each view's image and of its board.
    pixels : (N, 2) of each view's corners.
    """
    places, shown = places_of(pixels), dict[str, list[int]]()
    for view, image in enumerate(images):
        shown.setdefault(image, []).append(view)
    # Only images of the same boards can be duplicates.
    alike: dict[tuple[str, ...], list[list[int]]] = {}
    for own in shown.values():
        if len(own) > 1:
            own.sort(key=lambda view: (boards[view], places[view].tolist()))
        alike.setdefault(tuple(boards[view] for view in own), []).append(own)
    number = {image: i for i, image in enumerate(shown)}
    for group in alike.values():
        one, other = close_pairs(places[np.array(group)].reshape(len(group), -1), REPEATED_PX)
        for later, first in enumerate(connected_components(one, other, len(group)).tolist() if len(one) else ()):
            number[images[group[later][0]]] = number[images[group[first][0]]]
    _, dense = np.unique([number[name] for name in images], return_inverse=True)
    return dense.astype(np.int64)


def close_pairs(points: FloatArray, reach: float) -> tuple[IntArray, IntArray]:
    """Return the pairs i < j, (P,) each, of points (N, D), D > 1, that are within `reach` of each other along every
    axis."""
    extent = np.ptp(points, axis=0)
    axes = np.argsort(extent, kind="stable")
    many = len(points) > MAX_ALONG_ONE_AXIS
    side = max(reach, MIN_STRIP * float(extent.max()), np.finfo(float).tiny)
    place, length = points[:, axes[-1]], 0.0
    if many:
        # Strips across the axis of the largest extent, sorted along the axis of the second largest: close points are in
        # the same strip or in the next.
        strip, along = (place - place.min()) // side, points[:, axes[-2]]
        length = float(extent[axes[-2]]) + 4.0 * side
        place = along - along.min() + strip * length
    order = np.argsort(place, kind="stable")
    place = place[order]
    ends = np.zeros((len(points), 4), np.int64)
    ends[:, 0] = np.arange(1, len(points) + 1)
    ends[:, 1] = np.searchsorted(place, place + SEARCH_FACTOR * side, side="right")
    if many:
        ends[:, 2] = np.searchsorted(place, place + length - SEARCH_FACTOR * side)
        ends[:, 3] = np.searchsorted(place, place + length + SEARCH_FACTOR * side)
    # Axes in the order of their extents, the sorted one last: the first comparisons then reject most pairs.
    pairs = order[pairs_within(points[order][:, np.roll(axes[::-1], -1)], reach, ends)]
    pairs.sort(axis=1)
    return pairs[:, 0], pairs[:, 1]


def connected_components(one: IntArray, other: IntArray, count: int) -> IntArray:
    """Return for each of `count` things the first one of its connected component, for edges (P,) each."""
    first = np.arange(count)
    while True:
        before = first.copy()
        np.minimum.at(first, one, before[other])
        np.minimum.at(first, other, before[one])
        first = first[first]
        if (first == before).all():
            return first


def places_of(pixels: Sequence[Pixels]) -> FloatArray:
    """Return for each view (V, 7): the number of corners, their centre, and their extents along the image's axes and
    diagonals, px."""
    count = np.array([len(corners) for corners in pixels])
    start, corners = np.cumsum(count) - count, np.concatenate([np.asarray(one) for one in pixels])
    along = np.array([[1.0, 0.0], [0.0, 1.0], [1.0, 1.0], [1.0, -1.0]]) @ corners.T
    centre = np.add.reduceat(along[:2], start, axis=1) / count
    extents = np.maximum.reduceat(along, start, axis=1) - np.minimum.reduceat(along, start, axis=1)
    return np.concatenate([count[None], centre, extents]).T
