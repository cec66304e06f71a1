"""The kernels in light.c and paper.c: steps of the light in the windows of corners, and what lies beyond the outermost
squares of boards."""

from __future__ import annotations

import math

import numpy as np

from rigkit.core.arrays import BoolArray, FloatArray, GreyImage, IntArray
from rigkit.kernels import kernels
from rigkit.kernels.calls import Struct, image_arguments, structure
from rigkit.kernels.declarations import header

LIGHT_OUTCOMES, LIGHT_ASIDE, LIGHT_BLOCK = (
    header().constants[name] for name in ("LIGHT_OUTCOMES", "LIGHT_ASIDE", "LIGHT_BLOCK")
)


@structure("light_rules_t")
class LightRules(Struct):
    """The constants of `detection.subpixel.shadows`."""


def fit_light_steps(
    image: GreyImage,
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
    most = (2 * math.ceil(rules.radius_px) + 1) ** 2 + LIGHT_BLOCK
    out = np.empty((len(start), LIGHT_OUTCOMES))
    kernels().fit_light_steps(
        *(*image_arguments(image), len(start), start, sides, curvature, aside),
        *(blur, most_step, rules, most, np.empty((4, most)), out),
    )
    return out


def lit_unevenly(
    image: GreyImage,
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
    out = np.empty(len(pixels), np.bool_)
    kernels().lit_unevenly(
        *(*image_arguments(image), len(pixels), pixels, sides, aside, ends),
        *(along, len(along), most_aside, least_px, uneven, out),
    )
    return out


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
    library, count = kernels(), len(pixels)
    scratch, near = np.empty(2 * rules.step_count + 4 * count), np.empty(4 * count, np.int64)
    memory = np.empty(library.paper_memory(count), np.uint8)
    paper, out_gaps = np.empty((2, count, 2, 2))
    library.find_paper(
        *(*image_arguments(image), count, pixels, sides, gaps, ends, contrast, blur, sign, owner),
        *(rules, scratch, memory, near, paper, out_gaps),
    )
    return paper, out_gaps
