"""The kernel in circles.c: the fit of blurred circles."""

from __future__ import annotations

import numpy as np

from rigkit.core.arrays import FloatArray, GreyImage, IntArray
from rigkit.kernels import kernels
from rigkit.kernels.calls import Struct, image_arguments, structure
from rigkit.kernels.declarations import header

CIRCLE_OUTCOMES, SPOT, BESIDE = (header().constants[name] for name in ("CIRCLE_OUTCOMES", "SPOT", "BESIDE"))


@structure("circle_rules_t")
class CircleRules(Struct):
    """The constants of the circle model and its fit."""


def fit_circles(
    image: GreyImage,
    pixels: FloatArray,
    maps: FloatArray,
    bends: FloatArray,
    blur: FloatArray,
    reach: FloatArray,
    beside: IntArray,
    most: int,
    rules: CircleRules,
) -> FloatArray:
    """Return the outcomes of N circles, (N, 26). Arguments as `detection.circles.fit.fit_circles`; `most` : pixels of
    the largest window."""
    out, scratch = np.empty((len(pixels), CIRCLE_OUTCOMES)), np.empty((SPOT, most))
    kernels().fit_circles(
        *(*image_arguments(image), len(pixels), pixels, maps, bends, blur, reach, beside, rules, most, scratch, out)
    )
    return out
