"""Which images are left out together in cross-validation: by what they show, in whatever order they come.

A choice of model that changed when files were given other names would be no choice. Folds are dealt so that each has
boards as all have them: where they are in the image, how large and how slanted. What is left out then takes from none
of the others what only it could tell. Images that nearly repeat each other, as those of a film do, go together: left
out one by one they would be known from those that stay.

Measured on fifteen REAL captures: ten random ways to deal choose two or three models or shapes in ten of them, and
spread the held-out error by 1 to 15 %. In fourteen these folds choose what leaving out one image at a time chooses, or
what no fewer of the random ways do than anything else.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from rigkit.calibration.views.repeats import close_pairs, joined, places_of
from rigkit.core.arrays import FloatArray, IntArray, Pixels

NEARLY_ALIKE = 0.02
"""Boards whose centres and extents are alike within this part of the mean extent stand nearly where they stood: lens
and board err alike there. So does a board in a film from one frame to the next, hardly ever one moved by hand."""
ROUNDING = 1e-9
"""Places (px, and logarithms of extents) that differ by less are one."""


def folds_of(pixels: Sequence[Pixels], clusters: IntArray, folds: int) -> IntArray:
    """Return the fold (N,), from 0 on, of each of N clusters of views.

    Parameters
    ----------
    pixels : (C, 2) of each view's corners.
    clusters : (V,) number of the cluster of each view, as `cluster_numbers` has them.
    folds : how many; of fewer clusters each is one.
    """
    places = _means(places_of(pixels)[:, 1:], clusters)
    folds = min(folds, len(places))
    group = _nearly_alike(places, folds)
    return _dealt(_means(places, group), np.bincount(group), folds)[group]


def _means(values: FloatArray, group: IntArray) -> FloatArray:
    """Return the means (G, K) of the values (N, K) of each group."""
    count = np.bincount(group)
    return np.stack([np.bincount(group, column) / count for column in values.T], axis=1)


def _nearly_alike(places: FloatArray, folds: int) -> IntArray:
    """Return the group (N,) of each of N places (centre and extents), of those that are nearly alike; within a narrower
    limit where a group would be larger than a fold: boards that move without a stop are one long chain."""
    reach, most = NEARLY_ALIKE * float(places[:, 2:].mean()), -(-len(places) // folds)
    while True:
        one, other = close_pairs(places, reach)
        group = np.unique(joined(one, other, len(places)), return_inverse=True)[1].astype(np.int64)
        if not len(one) or np.bincount(group).max() <= most:
            return group
        reach *= 0.5


def _dealt(places: FloatArray, size: IntArray, folds: int) -> IntArray:
    """Return the fold (G,) of groups of so many images each: the most unlike the mean come first, each to the fold that
    has, of those with the fewest images so far, the most of the opposite."""
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
