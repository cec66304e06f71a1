"""The kernel in tags.c: the fit of whole tags whose modules are known."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from rigkit.core.arrays import BoolArray, FloatArray, GreyImage
from rigkit.kernels import kernels
from rigkit.kernels.calls import Struct, structure
from rigkit.kernels.declarations import header

TAG_SIDE = header().constants["TAG_SIDE"]


@structure("tag_rules_t")
class TagRules(Struct):
    """The constants of the model of a tag and its fit."""


class TagsToFit(NamedTuple):
    """N tags in an image and the state that their fit starts from, in the order of the kernel `fit_tags`.

    Attributes
    ----------
    maps : (N, 2, 10) polynomials of 1, u, v, uu, uv, vv, uuu, uuv, uvv, vvv, (u, v) the position from `centres` (N, 2)
        over `scales` (N,): the place in the tag, (0, 0) to (1, 1).
    ink : (N, C, C) which of the cells between the `breaks` (C - 1,) along y and x are dark.
    reach : distance beyond the tag up to which pixels are used, in its sides.
    blur, contrast : (N,) initial values.
    curvature_sigma : (N,) standard deviation of the middles of the sides relative to their ends, px.
    """

    maps: FloatArray
    centres: FloatArray
    scales: FloatArray
    ink: BoolArray
    breaks: FloatArray
    reach: float
    blur: FloatArray
    contrast: FloatArray
    curvature_sigma: FloatArray


def fit_tags(image: GreyImage, tags: TagsToFit, rules: TagRules) -> FloatArray:
    """Return the outcomes of N tags, (N, 16)."""
    largest = float(np.max(tags.scales, initial=1.0))
    capacity = int((2.0 * (1.0 + 2.0 * tags.reach) * largest / TAG_SIDE + 2.0) ** 2)
    return np.asarray(kernels().fit_tags(image, *tags, rules, capacity))
