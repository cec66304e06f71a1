"""Near-duplicate images, and the folds of the cross-validation over images, both from the boards' places.

The same boards at the same places are one measurement, not two. Folds are independent of the order of the images, so
that renaming files does not change the model selection. They are stratified: each has the same distribution of
position, size and slant of the boards, so that no fold contains the only images of their kind. Images that are nearly
equal, as in a video, are in one fold: else a held-out image would be known from its neighbours.

Measured on fifteen REAL captures: ten random assignments choose two or three models or shapes in ten of them, and vary
the held-out error by 1 to 15 %. In fourteen of the captures these folds choose what leave-one-out chooses, or what the
largest number of the random assignments chooses.
"""

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
NEARLY_ALIKE = 0.02
"""Boards whose centres and extents agree within this part of the mean extent are nearly at the same place, with the
same model errors: a board in a video from one frame to the next, hardly ever one moved by hand."""
ROUNDING = 1e-9
"""Smallest standard deviation of places (px, and logarithms of extents)."""


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


def folds_of(pixels: Sequence[Pixels], clusters: IntArray, folds: int) -> IntArray:
    """Return the fold (N,), from 0 on, of each of N clusters of views.

    Parameters
    ----------
    pixels : (C, 2) of each view's corners.
    clusters : (V,) `cluster_numbers` of the views.
    folds : number of folds; with fewer clusters each is a fold.
    """
    places = _means(places_of(pixels)[:, 1:], clusters)
    folds = min(folds, len(places))
    group = _nearly_alike(places, folds)
    return _assigned(_means(places, group), np.bincount(group), folds)[group]


def _means(values: FloatArray, group: IntArray) -> FloatArray:
    """Return the means (G, K) of the values (N, K) of each group."""
    count = np.bincount(group)
    return np.stack([np.bincount(group, column) / count for column in values.T], axis=1)


def _nearly_alike(places: FloatArray, folds: int) -> IntArray:
    """Return the group (N,) of nearly equal places (N, 6), centre and extents. The limit is lowered where a group would
    be larger than a fold: boards that move continuously form one long chain."""
    reach, most = NEARLY_ALIKE * float(places[:, 2:].mean()), -(-len(places) // folds)
    while True:
        one, other = close_pairs(places, reach)
        group = np.unique(connected_components(one, other, len(places)), return_inverse=True)[1].astype(np.int64)
        if not len(one) or np.bincount(group).max() <= most:
            return group
        reach *= 0.5


def _assigned(places: FloatArray, size: IntArray, folds: int) -> IntArray:
    """Return the fold (G,) of groups of so many images each. Groups are assigned in the order of their distance from
    the mean, each to the fold, of those with the fewest images so far, whose sum is most opposite to it."""
    centre, extents = places[:, :2], np.maximum(places[:, 2:], np.finfo(float).tiny)
    along = np.log(extents)
    unlike = np.column_stack([centre, along.mean(axis=1), along[:, 0] - along[:, 1], along[:, 2] - along[:, 3]])
    unlike -= unlike.mean(axis=0)
    unlike /= np.maximum(unlike.std(axis=0), ROUNDING)
    filled, total = np.zeros(folds, dtype=np.int64), np.zeros((folds, unlike.shape[1]))
    out = np.empty(len(size), dtype=np.int64)
    for k in np.argsort(-(unlike**2).sum(axis=1), kind="stable").tolist():
        open_ = np.flatnonzero(filled == filled.min())
        out[k] = fold = open_[(total[open_] @ unlike[k]).argmin()]
        filled[fold] += size[k]
        total[fold] += unlike[k]
    return out
