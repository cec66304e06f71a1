"""The kernel in tags.c: the fit of whole tags whose modules are known."""

from __future__ import annotations

import numpy as np

from rigkit.core.arrays import BoolArray, FloatArray, GreyImage
from rigkit.kernels import kernels
from rigkit.kernels.calls import Struct, structure
from rigkit.kernels.declarations import header

TAG_SIDE = header().constants["TAG_SIDE"]


@structure("tag_rules_t")
class TagRules(Struct):
    """The constants of the model of a tag and its fit."""


def fit_tags(
    image: GreyImage,
    maps: FloatArray,
    centres: FloatArray,
    scales: FloatArray,
    ink: BoolArray,
    breaks: FloatArray,
    reach: float,
    blur: FloatArray,
    contrast: FloatArray,
    curvature_sigma: FloatArray,
    rules: TagRules,
) -> FloatArray:
    """Return the outcomes of N tags, (N, 16).

    Parameters
    ----------
    maps : (N, 2, 10) polynomials of 1, u, v, uu, uv, vv, uuu, uuv, uvv, vvv, (u, v) the position from `centres` (N, 2)
        over `scales` (N,): the place in the tag, (0, 0) to (1, 1).
    ink : (N, C, C) which of the cells between the `breaks` (C - 1,) along y and x are dark.
    reach : distance beyond the tag up to which pixels are used, in its sides.
    blur, contrast : (N,) initial values.
    curvature_sigma : (N,) standard deviation of the middles of the sides relative to their ends, px.
    """
    capacity = int((2.0 * (1.0 + 2.0 * reach) * float(np.max(scales, initial=1.0)) / TAG_SIDE + 2.0) ** 2)
    out = kernels().fit_tags(
        image, maps, centres, scales, ink, breaks, reach, blur, contrast, curvature_sigma, rules, capacity
    )
    return np.asarray(out)
