"""Interlaced images: even and odd lines are exposed at different times and show moving objects at different places.

Without a shift a line is the mean of its neighbours up to second differences, whose sign does not alternate with the
lines. The part of the difference that alternates is therefore the shift between the fields times the slope along the
line.
"""

from __future__ import annotations

import cv2
import numpy as np

from rigkit.core.arrays import BoolArray, FloatArray, Pixels
from rigkit.detection.saddles.response import FloatImage, GreyImage
from rigkit.kernels import front

FIELDS_MARGIN_PX = 6
"""Margin of the evaluated part of the image around the outermost corners."""

MAX_LINES = 1088
"""No interlaced format has more lines: larger images are not checked."""

GROUPS, TILES, MIN_TILES = 60, 8, 2
"""Groups of four lines that are looked at, tiles across and down the image (a moving board may be a small part), and
the fewest tiles of two moments: what one tile shows, some tens of pixels, matches elsewhere by chance."""

LINE_STEP, MIN_ALTERNATING, LINE_SHARE = 32.0, 3.0, 0.02
"""A tile is of two moments if more places, by MIN_ALTERNATING and LINE_SHARE of all, have differences within four lines
that alternate from line to line rather than lie between the first and the last two; of the larger of both by at least
LINE_STEP, the sum of four grey levels. White noise, bad pixels and dither have up to 1.5 times as many in a tile, REAL
images whose lines are 2 px apart 7 times and more; where hardly anything lies between, LINE_SHARE decides."""

MIN_APART_PX, MAX_APART_PX = 4, 32
BETTER_MATCH = 0.5
"""Smallest and largest shift between the fields that is undone, and the largest squared difference of the fields at
their shift over that without it, and over those from MIN_APART_PX to thrice as far from the shift: lines of a screen
match nowhere better, and lines of about two pixels, as of fabrics and blinds, equally well along themselves."""

LINE_SPLINE = np.array([1.0, 8.0, 23.0, 32.0, 23.0, 8.0, 1.0]) / 96.0
"""A cubic B-spline through every second line. It does not pass through the lines: interpolation that does moves edges
that are sharper than the lines of one field by 0.05 px, and along the lines the blur must be the same."""


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


def of_one_moment(grey: GreyImage) -> GreyImage:
    """Return the even lines of `grey`, smoothed to an image of its size, if the fields show something at places
    MIN_APART_PX apart or more; else `grey`.

    Closer fields are left: corners halfway between them have twice the lines, and the fit knows their blur.
    """
    height, width = grey.shape
    if not 4 * TILES <= height <= MAX_LINES or width < TILES:
        return grey
    tiles = _alternating_tiles(grey)
    if np.count_nonzero(tiles) < MIN_TILES:
        return grey
    (top, bottom), (left, right) = (
        (int(at[0]) * side // TILES, (int(at[-1]) + 1) * side // TILES)
        for at, side in ((np.flatnonzero(tiles.any(axis=1 - axis)), side) for axis, side in ((0, height), (1, width)))
    )
    part = grey[top - top % 2 : bottom, left:right].astype(np.float32)
    if not _fields_apart(part):
        return grey
    even: FloatImage = np.zeros(grey.shape, np.float32)
    even[::2] = 2.0 * grey[::2]
    return np.asarray(cv2.sepFilter2D(even, -1, LINE_SPLINE, LINE_SPLINE), np.float32)


def _alternating_tiles(grey: GreyImage) -> BoolArray:
    """Return which of the tiles (TILES, TILES) have MIN_ALTERNATING."""
    height, width = grey.shape
    groups = min(GROUPS, height // 4) // TILES * TILES
    more, less = front.alternating(grey, groups, TILES, LINE_STEP)
    return np.asarray(more > MIN_ALTERNATING * less + LINE_SHARE * (width // TILES) * (groups // TILES))


def _fields_apart(part: FloatImage) -> bool:
    """Return whether the even lines of `part` (H, W) match its odd ones at a distance, and there alone."""
    even, odd = part[2:-1:2], 0.5 * (part[1:-2:2] + part[3::2])[: len(part[2:-1:2])]
    even = even[: len(odd)]
    down, across = (min(MAX_APART_PX // step, side // 4) for step, side in ((2, len(odd)), (1, odd.shape[1])))
    if min(down, across) < 1:
        return False
    inner = np.ascontiguousarray(odd[down : len(odd) - down, across : odd.shape[1] - across])
    off = cv2.matchTemplate(np.ascontiguousarray(even), inner, cv2.TM_SQDIFF)
    best, _, (u, v), _ = cv2.minMaxLoc(off)
    if np.hypot(u - across, 2.0 * (v - down)) < MIN_APART_PX:
        return False
    away = np.hypot(np.arange(off.shape[1]) - u, 2.0 * (np.arange(off.shape[0])[:, None] - v))
    around = (away >= MIN_APART_PX) & (away <= 3.0 * MIN_APART_PX)
    return bool(best < BETTER_MATCH * min(off[down, across], off[around].min()))
