"""The kernels in blobs.c, circle_maps.c and circles.c: blobs, maps of lattices, and the fit of blurred circles."""

from __future__ import annotations

import numpy as np

from rigkit.core.arrays import BoolArray, FloatArray, GreyImage, IntArray
from rigkit.kernels import kernels
from rigkit.kernels.calls import Struct, structure
from rigkit.kernels.declarations import header
from rigkit.kernels.front import Image

BESIDE = header().constants["BESIDE"]


@structure("circle_rules_t")
class CircleRules(Struct):
    """The constants of the circle model and its fit."""


@structure("blob_rules_t")
class BlobRules(Struct):
    """The constants of `detection.circles.blobs`."""


@structure("prediction_rules_t")
class PredictionRules(Struct):
    """The constants of `detection.circles.local_map`."""


def find_blobs(off: Image, variance: Image, rules: BlobRules) -> FloatArray:
    """Return the blobs (N, BLOB_COLUMNS) of an image: `off` is its difference from the local mean, with a local
    `variance`, both (H, W)."""
    count, rows = kernels().find_blobs(off, variance, rules)
    return np.asarray(rows[:count])


def local_maps(
    table: FloatArray,
    places: IntArray,
    offsets: IntArray,
    plane: FloatArray,
    weights: FloatArray,
    near: BoolArray,
    typical: FloatArray,
    rules: PredictionRules,
) -> FloatArray:
    """Return the maps (M, PREDICTED_COLUMNS) around `places` (M, 2), indices of a `table` (R, C, 2) of circles.

    `offsets` (K, 2) lead to the circles used, at positions `plane` (K, 2), with `weights` (K,); `near` (K,) are those
    that surround a place.
    """
    return np.asarray(kernels().local_maps(table, places, offsets, plane, weights, near.view(np.uint8), typical, rules))


def fit_circles(
    image: GreyImage,
    pixels: FloatArray,
    maps: FloatArray,
    curvatures: FloatArray,
    blur: FloatArray,
    uneven: FloatArray,
    reach: FloatArray,
    beside: IntArray,
    capacity: int,
    rules: CircleRules,
) -> FloatArray:
    """Return the outcomes of N circles, (N, 40). Arguments as for `detection.circles.fit.fit_circles`; `capacity` is
    the number of pixels of the largest window."""
    return np.asarray(
        kernels().fit_circles(image, pixels, maps, curvatures, blur, uneven, reach, beside, rules, capacity)
    )
