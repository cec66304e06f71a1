"""Interlaced pictures: even and odd lines are of two moments, and what moved between them is shifted in every second
line.

A line that lies where its neighbours lie is their mean, but for what curves from line to line, which has no sign that
changes with every line. So the difference from that mean, with a sign that changes, is the shift between both fields
times the slope along the line.
"""

from __future__ import annotations

import numpy as np

from rigkit.core.arrays import FloatArray, Pixels

FIELDS_MARGIN_PX = 6
"""So far around the outermost corners lines are looked at."""


def shift_between_fields(image: FloatArray, pixels: Pixels) -> float:
    """Return by how many px odd lines of a grey image (H, W) are shifted to the right against even ones, where the
    corners at `pixels` (N, 2) are; 0 where nothing is to be seen there. Of shifts wider than edges are blurred less is
    told."""
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
