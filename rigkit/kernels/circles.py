"""The kernel in circles.c: the fit of blurred circles."""

from __future__ import annotations

import numpy as np

from rigkit.core.arrays import FloatArray, GreyImage, IntArray
from rigkit.kernels import kernels
from rigkit.kernels.calls import Struct, structure
from rigkit.kernels.declarations import header

BESIDE = header().constants["BESIDE"]


@structure("circle_rules_t")
class CircleRules(Struct):
    """The constants of the circle model and its fit."""


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
    """Return the outcomes of N circles, (N, 36). Arguments as for `detection.circles.fit.fit_circles`; `capacity` is
    the number of pixels of the largest window."""
    return np.asarray(
        kernels().fit_circles(image, pixels, maps, curvatures, blur, uneven, reach, beside, rules, capacity)
    )
