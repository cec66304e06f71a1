"""The kernel in light.c: steps of the light in the windows of corners."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from rigkit.core.arrays import BoolArray, FloatArray
from rigkit.kernels import kernels
from rigkit.kernels.calls import Struct, structure
from rigkit.kernels.declarations import header

LIGHT_OUTCOMES, LIGHT_ASIDE, LIGHT_BLOCK = (
    header().constants[name] for name in ("LIGHT_OUTCOMES", "LIGHT_ASIDE", "LIGHT_BLOCK")
)


@structure("light_rules_t")
class LightRules(Struct):
    """The constants of `detection.subpixel.shadows`."""


def fit_light_steps(
    image: NDArray[np.uint8] | NDArray[np.float32],
    start: FloatArray,
    sides: FloatArray,
    curvature: FloatArray,
    aside: FloatArray,
    blur: float,
    most_step: FloatArray,
    rules: LightRules,
) -> FloatArray:
    """Return the outcomes of N corners, (N, 8). Arguments as `detection.subpixel.shadows.light_steps`; what a step
    of the fit changes is `most_step` (11,) at most."""
    grey = np.ascontiguousarray(image, None if image.dtype == np.uint8 else np.float32)
    known = [np.ascontiguousarray(part, np.float64) for part in (start, sides, curvature, aside)]
    most = (2 * math.ceil(rules.radius_px) + 1) ** 2 + LIGHT_BLOCK
    out = np.empty((len(start), LIGHT_OUTCOMES))
    height, width = grey.shape
    kernels().fit_light_steps(
        *(grey, grey.dtype == np.uint8, width, height, len(start), *known, blur, most_step, rules),
        *(most, np.empty((4, most)), out),
    )
    return out


def lit_unevenly(
    image: NDArray[np.uint8] | NDArray[np.float32],
    pixels: FloatArray,
    sides: FloatArray,
    aside: FloatArray,
    ends: BoolArray,
    along: FloatArray,
    most_aside: float,
    least_px: float,
    uneven: float,
) -> BoolArray:
    """Return which of N corners are lit unevenly, as `detection.subpixel.shadows.beside_shadows`.

    The last four are its constants.
    """
    grey = np.ascontiguousarray(image, None if image.dtype == np.uint8 else np.float32)
    known = [np.ascontiguousarray(part, np.float64) for part in (pixels, sides, aside)]
    height, width = grey.shape
    out = np.empty(len(pixels), np.bool_)
    kernels().lit_unevenly(
        *(grey, grey.dtype == np.uint8, width, height, len(pixels), *known, np.ascontiguousarray(ends, np.bool_)),
        *(along, len(along), most_aside, least_px, uneven, out),
    )
    return out
