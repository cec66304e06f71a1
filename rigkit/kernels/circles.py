"""The kernel in circles.c: the fit of blurred circles."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from rigkit.core.arrays import FloatArray
from rigkit.kernels import kernels
from rigkit.kernels.calls import Struct, structure
from rigkit.kernels.declarations import header

CIRCLE_OUTCOMES, SPOT = (header().constants[name] for name in ("CIRCLE_OUTCOMES", "SPOT"))


@structure("circle_rules_t")
class CircleRules(Struct):
    """The constants of the circle model and its fit."""


def fit_circles(
    image: NDArray[np.uint8] | NDArray[np.float32],
    pixels: FloatArray,
    maps: FloatArray,
    bends: FloatArray,
    blur: FloatArray,
    reach: FloatArray,
    most: int,
    rules: CircleRules,
) -> FloatArray:
    """Return the outcomes of N circles, (N, 23). Arguments as `detection.circles.fit.fit_circles`; `most` : pixels of
    the largest window."""
    grey = np.ascontiguousarray(image, None if image.dtype == np.uint8 else np.float32)
    known = [np.ascontiguousarray(part, np.float64) for part in (pixels, maps, bends, blur, reach)]
    out = np.empty((len(pixels), CIRCLE_OUTCOMES))
    scratch = np.empty((SPOT, most))
    height, width = grey.shape
    kernels().fit_circles(
        *(grey, grey.dtype == np.uint8, width, height, len(pixels)), *known, rules, most, scratch, out
    )
    return out
