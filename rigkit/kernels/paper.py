"""The kernel in paper.c: what lies beyond the outermost squares of boards."""

from __future__ import annotations

import numpy as np

from rigkit.core.arrays import BoolArray, FloatArray, GreyImage, IntArray
from rigkit.kernels import kernels
from rigkit.kernels.calls import Struct, image_arguments, structure


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
