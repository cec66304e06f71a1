"""The ends of the outermost squares of a board, and the brightness beyond, which blur brings into the corners' windows.

Sheets may be cut, and margins begin, anywhere: the outer squares of some boards are half as wide as the others. Along
the edge outwards from an outermost corner, the difference of the squares on both sides vanishes at their end, where a
blurred difference is halved, unless there are squares that the lattice lacks. Their mean changes there from that of the
corner to the brightness beyond.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from rigkit.core.arrays import BoolArray, FloatArray, IntArray, upper_median
from rigkit.detection.saddles.response import GreyImage
from rigkit.detection.subpixel.edge_fit import EdgeFit
from rigkit.detection.subpixel.edge_model import TAIL_SIGMAS, WINDOW_REACH, Geometry
from rigkit.kernels.light import PaperRules, find_paper

MIN_PAPER_BLUR = 1.0
"""Smallest s, px, for which the image beyond the outermost squares is modelled: in sharper images it shifts corners by
less than half their sigma, even on boards with cut squares (10 REAL images: 0.018 px; with s = 1.5 px it is 0.055 px,
1.1 sigmas)."""

SUSPECT_RESIDUAL = 1.5
"""Ratio of the residual of an outermost corner to the median of the inner ones above which its window may show more
than the board's squares: by chance it is 1.15."""

STEPS_SQUARES = np.arange(0.1, 1.6001, 0.05)
"""Distances outwards at which brightness is read, in squares."""

LATERAL_SQUARES = 0.4
"""Distance to both sides of the edge at which brightness is read, in squares: near the middles of the squares, where
the blurred difference is largest, but still within them if the edge is bent."""

FIRST, LAST = 0.6, 1.25
"""Distance within which the largest difference is sought, and largest distance of the end of outer squares, in
squares."""

GOES_ON, CUT = -0.4, 0.8
"""The board continues if the difference reverses by this part of the contrast, unless the squares end before CUT
squares, so that they are cut and the difference beyond is something else."""

MAX_REFERENCE_RATIO = 2.5
"""Largest distance, in sides of the cell, between corners that share readings of the paper."""

SEEN = 0.8413
"""Share of the brightness beyond an edge at one standard deviation of the blur behind it, where it is read: further out
a narrow margin may have ended."""

MAX_PAPER = 1.6
"""Largest difference of the paper from the mean of the squares, in half contrasts; that of squares is 1."""

PAPER_ROUNDS, SETTLED_PX = 4, 0.03
"""Largest number of rounds of reading the image beyond the outermost squares and fitting the corners; those that move
by less than SETTLED_PX are not fitted again."""


def fitted_beside_paper(
    image: GreyImage,
    geometry: Geometry,
    fit: EdgeFit,
    fitted: Callable[[BoolArray, Geometry], EdgeFit],
    signs: FloatArray,
    owner: IntArray,
    wanted: BoolArray | None = None,
) -> EdgeFit:
    """Return the `fit` of N corners, of boards `owner` (N,), after fitting those again whose windows extend beyond
    their board; the same `fit` if none do. `wanted` (N,) limits these corners, `fitted` fits them."""
    again = windows_beyond_board(geometry, fit, owner)
    again = again if wanted is None else again & wanted
    moving = again
    for _ in range(PAPER_ROUNDS if again.any() else 0):
        on_paper = with_paper(image, geometry.of(again), fit.of(again), signs[again], owner[again])
        before, which = fit.pixels[moving], moving[again]
        fit = fit.with_part(moving, fitted(moving, on_paper.of(which)))
        moving = moving.copy()
        moving[moving] = np.linalg.norm(fit.pixels[moving] - before, axis=1) >= SETTLED_PX
        if not moving.any():
            break
    return fit


def windows_beyond_board(geometry: Geometry, fit: EdgeFit, owner: IntArray) -> BoolArray:
    """Return which of N corners, of boards `owner` (N,), may have windows extending beyond their board."""
    good = fit.valid & (fit.contrast > 0.0)
    soft = np.zeros(int(owner.max(initial=-1)) + 1, np.bool_)
    for k in range(len(soft)):
        mine = fit.blur[good & (owner == k)]
        soft[k] = len(mine) > 0 and upper_median(mine) >= MIN_PAPER_BLUR
    good &= soft[owner]
    if not good.any():
        return good
    blurred = TAIL_SIGMAS * fit.blur[:, None] > (1.0 - WINDOW_REACH) * geometry.gaps.reshape(-1, 4)
    ends = geometry.ends.reshape(-1, 4)
    relative = fit.residual / np.where(good, fit.contrast, np.inf)
    typical = np.full(len(soft), np.inf)
    # Corners with neighbours on all sides; on boards without such corners all.
    inner = good & ~ends.any(axis=1)
    for k in np.flatnonzero(soft).tolist():
        mine = owner == k
        typical[k] = upper_median(relative[mine & (inner if (inner & mine).any() else good)])
    suspect = relative > SUSPECT_RESIDUAL * typical[owner]
    return good & np.asarray((ends & (blurred | suspect[:, None])).any(axis=1))


def with_paper(image: GreyImage, geometry: Geometry, fit: EdgeFit, sign: FloatArray, owner: IntArray) -> Geometry:
    """Return the `geometry` of N corners `fit` with `paper` beyond their ends, and `gaps` up to the paper.

    `sign` (N,) as for `edge_fit.fit_edges`, `owner` (N,) the index of each corner's board. Readings are medians over
    nearby corners on the same side of the board.
    """
    paper, gaps = find_paper(
        *(image, fit.pixels, geometry.sides, geometry.gaps, geometry.ends),
        *(fit.contrast, fit.blur, sign, owner, _rules()),
    )
    return replace(geometry, gaps=gaps, paper=paper)


def outer_squares(
    image: GreyImage, geometry: Geometry, pixels: FloatArray, contrast: FloatArray, blur: FloatArray, sign: FloatArray
) -> FloatArray:
    """Return the widths (N, 2, 2), in squares, of the outermost squares at N corners of a board; NaN if no end is
    found.

    `pixels` (N, 2), `contrast` and `blur` (N,) of the corners; `sign` (N,) as for `edge_fit.fit_edges`.
    """
    owner = np.zeros(len(pixels), np.int64)
    known = geometry.sides, geometry.gaps, geometry.ends
    paper, gaps = find_paper(image, pixels, *known, contrast, blur, sign, owner, _rules())
    return np.where(np.isfinite(paper), gaps / geometry.gaps, np.nan)


@functools.cache
def _rules() -> PaperRules:
    return PaperRules.of(
        steps=STEPS_SQUARES,
        lateral=LATERAL_SQUARES,
        first=FIRST,
        last=LAST,
        goes_on=GOES_ON,
        cut=CUT,
        near_witness=MAX_REFERENCE_RATIO,
        seen=SEEN,
        max_paper=MAX_PAPER,
    )
