"""The kernels in light.c and paper.c: steps of the light in the windows of corners, and the image beyond the outermost
squares of boards."""

from __future__ import annotations

import math

import numpy as np

from rigkit.core.arrays import BoolArray, FloatArray, GreyImage, IntArray
from rigkit.kernels import kernels
from rigkit.kernels.calls import Struct, structure
from rigkit.kernels.declarations import header

LIGHT_LATERAL, LIGHT_BLOCK = (header().constants[name] for name in ("LIGHT_LATERAL", "LIGHT_BLOCK"))


@structure("light_rules_t")
class LightRules(Struct):
    """The constants of `detection.subpixel.shadows`."""


def fit_light_steps(
    image: GreyImage,
    start: FloatArray,
    sides: FloatArray,
    curvature: FloatArray,
    lateral: FloatArray,
    blur: float,
    max_step: FloatArray,
    rules: LightRules,
) -> FloatArray:
    """Return the outcomes of N corners, (N, 8). Arguments as for `detection.subpixel.shadows.light_steps`; `max_step`
    (11,) are the largest changes per iteration."""
    capacity = (2 * math.ceil(rules.radius_px) + 1) ** 2 + LIGHT_BLOCK
    return np.asarray(
        kernels().fit_light_steps(image, start, sides, curvature, lateral, blur, max_step, rules, capacity)
    )


def lit_unevenly(
    image: GreyImage,
    pixels: FloatArray,
    sides: FloatArray,
    lateral: FloatArray,
    ends: BoolArray,
    along: FloatArray,
    max_lateral: float,
    min_px: float,
    uneven: float,
) -> BoolArray:
    """Return which of N corners are lit unevenly, as `detection.subpixel.shadows.beside_shadows`.

    The last four are its constants.
    """
    return np.asarray(kernels().lit_unevenly(image, pixels, sides, lateral, ends, along, max_lateral, min_px, uneven))


@structure("paper_rules_t")
class PaperRules(Struct):
    """The constants of `detection.subpixel.outer_squares`."""


def find_paper(
    image: GreyImage,
    pixels: FloatArray,
    sides: FloatArray,
    gaps: FloatArray,
    ends: BoolArray,
    contrast: FloatArray,
    blur: FloatArray,
    sign: FloatArray,
    owner: IntArray,
    rules: PaperRules,
) -> tuple[FloatArray, FloatArray]:
    """Return `paper` and `gaps`, (N, 2, 2) each, as `detection.subpixel.outer_squares.with_paper` sets them."""
    found: tuple[FloatArray, FloatArray] = kernels().find_paper(
        image, pixels, sides, gaps, ends, contrast, blur, sign, owner, rules
    )
    return found
