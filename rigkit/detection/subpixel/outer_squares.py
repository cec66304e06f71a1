"""What lies beyond the outermost squares of a board, and where they end.

Blur brings both into the windows of the outermost corners. Sheets are cut, and margins begin, anywhere: of some boards
the outer squares are half as wide as the others. On the way out from such a corner the two squares differ in brightness
to the end of them, where a blurred difference is halved, and beyond they do not, unless there are squares that the
lattice has not. The mean of both sides goes, over the same edge, from that of the corner to the brightness beyond.
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
"""In a sharper image, px, what lies beyond the outermost squares moves corners by less than half their sigma, even of
boards with cut squares (10 real images: 0.018 px; with blur 1.5 px it is 0.055 px, 1.1 sigmas)."""

SUSPECT_RESIDUAL = 1.5
"""Outermost corners that fit worse than this times what is typical of the inner ones may have more in their windows:
chance makes 1.15."""

STEPS_SQUARES = np.arange(0.1, 1.6001, 0.05)
"""Where brightness is read, in squares outwards."""

LATERAL_SQUARES = 0.4
"""And so far to both sides of the edge, in squares: near the middles of the squares, where blur leaves most of their
difference, but still inside where the edge is bent."""

FIRST, LAST = 0.6, 1.25
"""The difference is largest nearer than the one, in squares; squares that end beyond the other are no outer ones."""

GOES_ON, CUT = -0.4, 0.8
"""Where the difference comes back the other way round, by this part of the contrast, the board goes on; but squares
that end so early, in squares, are cut, and what differs beyond is something else."""

MAX_REFERENCE_RATIO = 2.5
"""A corner that tells what lies beyond another one lies so near to it, in sides of its cell: paper is alike there."""

SEEN = 0.8413
"""Of what lies beyond an edge a pixel sees so much one standard deviation of the blur behind it. Further out a narrow
margin may have ended."""

MAX_PAPER = 1.6
"""Paper is this much brighter or darker than the mean of the squares at most, in half contrasts; squares are by 1."""

PAPER_ROUNDS, SETTLED_PX = 4, 0.03
"""What lies beyond the outermost squares is read with the corners as they are fitted so far, and again for those that
then move by more than the second number."""


def fitted_beside_paper(
    image: GreyImage,
    geometry: Geometry,
    fit: EdgeFit,
    fitted: Callable[[BoolArray, Geometry], EdgeFit],
    signs: FloatArray,
    owner: IntArray,
    wanted: BoolArray | None = None,
) -> EdgeFit:
    """Return the `fit` of N corners with those (of the `wanted`, (N,), where not all are) `fitted` again that see what
    lies beyond their board, `owner` (N,); the same `fit` where none do."""
    again = beside_paper(geometry, fit, owner)
    again = again if wanted is None else again & wanted
    moving = again
    for _ in range(PAPER_ROUNDS if again.any() else 0):
        beside = with_paper(image, geometry.of(again), fit.of(again), signs[again], owner[again])
        before, which = fit.pixels[moving], moving[again]
        fit = fit.with_part(moving, fitted(moving, beside.of(which)))
        moving = moving.copy()
        moving[moving] = np.linalg.norm(fit.pixels[moving] - before, axis=1) >= SETTLED_PX
        if not moving.any():
            break
    return fit


def beside_paper(geometry: Geometry, fit: EdgeFit, owner: IntArray) -> BoolArray:
    """Return which of N corners may see what lies beyond their board; `owner` (N,) is the number of that."""
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
    # Those that have corners on all sides; of a board that has none, all.
    inner = good & ~ends.any(axis=1)
    for k in np.flatnonzero(soft).tolist():
        mine = owner == k
        typical[k] = upper_median(relative[mine & (inner if (inner & mine).any() else good)])
    suspect = relative > SUSPECT_RESIDUAL * typical[owner]
    return good & np.asarray((ends & (blurred | suspect[:, None])).any(axis=1))


def with_paper(image: GreyImage, geometry: Geometry, fit: EdgeFit, sign: FloatArray, owner: IntArray) -> Geometry:
    """Return the `geometry` of N corners `fit` with `paper` beyond their ends, and `gaps` to where it begins.

    `sign` (N,) as for `edge_fit.fit_edges`, `owner` (N,) the number of each corner's board. Each reading is the median
    of those near it on its side of the board.
    """
    paper, gaps = find_paper(
        *(image, fit.pixels, geometry.sides, geometry.gaps, geometry.ends),
        *(fit.contrast, fit.blur, sign, owner, _rules()),
    )
    return replace(geometry, gaps=gaps, paper=paper)


def outer_squares(
    image: GreyImage, geometry: Geometry, pixels: FloatArray, contrast: FloatArray, blur: FloatArray, sign: FloatArray
) -> FloatArray:
    """Return how wide the outermost squares beside N corners of a board are, (N, 2, 2), in squares; NaN where none is
    seen to end.

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
