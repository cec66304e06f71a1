"""Interlaced images: even and odd lines are exposed at different times and show moving objects at different places.

Without a shift a line is the mean of its neighbours up to second differences, whose sign does not alternate with the
lines. The part of the difference that alternates is therefore the shift between the fields times the slope along the
line.
"""

from __future__ import annotations

import numpy as np

from rigkit.core.arrays import FloatArray, Pixels

FIELDS_MARGIN_PX = 6
"""Margin of the evaluated part of the image around the outermost corners."""


def shift_between_fields(image: FloatArray, pixels: Pixels) -> float:
    """Return the shift, px, of odd lines of a grey image (H, W) to the right of even ones, around the corners `pixels`
    (N, 2); 0 without contrast. Shifts larger than the blur of the edges are underestimated."""
    first = np.maximum(np.floor(pixels.min(axis=0)).astype(int) - FIELDS_MARGIN_PX, 0)
    last = np.ceil(pixels.max(axis=0)).astype(int) + FIELDS_MARGIN_PX + 1
    part = np.asarray(image[first[1] : last[1], first[0] : last[0]], dtype=np.float64)
    if min(part.shape) < 3:
        return 0.0
    slope = 0.5 * (part[1:-1, 2:] - part[1:-1, :-2])
    off = part[1:-1] - 0.5 * (part[:-2] + part[2:])
    odd = (np.arange(len(slope)) + first[1] + 1) % 2 == 1
    squares = float((slope**2).sum())
    if squares == 0.0:
        return 0.0
    return -float((np.where(odd, 1.0, -1.0)[:, None] * slope * off[:, 1:-1]).sum()) / squares
