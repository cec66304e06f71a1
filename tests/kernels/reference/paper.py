"""What `rigkit.detection.subpixel.outer_squares.with_paper` asks the kernel of paper.c for, in numpy."""

from __future__ import annotations

import warnings
from dataclasses import replace
from math import erf

import numpy as np

from rigkit.core.arrays import BoolArray, FloatArray, IntArray
from rigkit.detection.saddles.response import GreyImage, sample
from rigkit.detection.subpixel.edge_fit import EdgeFit
from rigkit.detection.subpixel.edge_model import Geometry
from rigkit.detection.subpixel.outer_squares import (
    CUT,
    FIRST,
    GOES_ON,
    LAST,
    LATERAL_SQUARES,
    MAX_PAPER,
    MAX_REFERENCE_RATIO,
    SEEN,
    STEPS_SQUARES,
)

OUTWARDS: FloatArray = np.array([[0.0, -1.0], [0.0, 1.0], [1.0, 0.0], [-1.0, 0.0]])
"""Which way out, in cells (column, row), each of the `Geometry.ends` is, in their order."""


def with_paper(image: GreyImage, geometry: Geometry, fit: EdgeFit, sign: FloatArray, owner: IntArray) -> Geometry:
    """Return the `geometry` of N corners `fit` with `paper` beyond their ends, and `gaps` to where it begins.

    `sign` (N,) as for `edge_fit.fit_edges`, `owner` (N,) the number of each corner's board.
    """
    who, which = np.nonzero(geometry.ends.reshape(-1, 4))
    # The way out is as long as the cell's side, which is the mean of what lies before and behind the corner.
    cell = np.repeat(geometry.gaps.mean(axis=2), 2, axis=1)[who, which]
    one, other = _beside_the_way_out(image, geometry, fit, who, which)
    beside = _beside(geometry, fit.pixels, owner, who, which)
    # Out there, a corner that was fitted without what lies beyond is wrong in contrast and blur, some more than others.
    contrast, blur = _middle(fit.contrast[who], beside), _middle(fit.blur[who], beside)
    with np.errstate(invalid="ignore", divide="ignore"):
        end, found = _end((one - other) / (contrast * _left(geometry, who, which, blur))[:, None])
        step = STEPS_SQUARES[1] - STEPS_SQUARES[0]
        at = (end + blur / cell - STEPS_SQUARES[0]) / step
        first = np.nan_to_num(at).clip(0.0, len(STEPS_SQUARES) - 2.0).astype(np.int64)
        mean, k = 0.5 * (one + other), np.arange(len(who))
        level = mean[k, first] + (at - first) * (mean[k, first + 1] - mean[k, first])
        bright = (level - sample(image, fit.pixels[who])) / (0.5 * contrast * SEEN)
        found &= (at <= len(STEPS_SQUARES) - 1.0) & (np.abs(bright) < MAX_PAPER)
        # Sheets are cut straight, and paper is alike: what noise makes of a single reading, its neighbours do not say.
        end, bright = (_middle(np.where(found, values, np.nan), beside) for values in (end, bright))
        found = np.isfinite(end)
    paper, gaps = np.full((len(fit.pixels), 4), np.nan), geometry.gaps.reshape(-1, 4).copy()
    paper[who[found], which[found]] = (bright * sign[who])[found]
    gaps[who[found], which[found]] = (end * cell)[found]
    return replace(geometry, gaps=gaps.reshape(-1, 2, 2), paper=paper.reshape(-1, 2, 2))


def _left(geometry: Geometry, who: IntArray, which: IntArray, blur: FloatArray) -> FloatArray:
    """Return (M,) what blur leaves of the difference of the two squares beside each way out."""
    # Beside the way out across line 1 lie squares of line 2, with their own edges and those of the next squares.
    across = geometry.gaps[who, 1 - which // 2].mean(axis=1) / (np.sqrt(2.0) * blur)
    return np.array([erf(LATERAL_SQUARES * x) + erf((1.0 - LATERAL_SQUARES) * x) - 1.0 for x in across.tolist()])


def _beside(geometry: Geometry, pixels: FloatArray, owner: IntArray, who: IntArray, which: IntArray) -> BoolArray:
    """Return (M, M) which ends tell of each end what lies beyond it: those near it, on its side of the board.

    The way out from the corner of a board has different things on either side: it tells nothing where others do.
    """
    apart = np.linalg.norm(pixels[who, None] - pixels[who], axis=2)
    near: BoolArray = apart < MAX_REFERENCE_RATIO * np.linalg.norm(geometry.sides[who], axis=2).max(axis=1)[:, None]
    near &= (which[:, None] == which) & (owner[who, None] == owner[who])
    single = geometry.ends.reshape(-1, 4)[who].sum(axis=1) == 1
    witnessed = near & single
    return np.asarray(np.where(witnessed.any(axis=1, keepdims=True), witnessed, near))


def _middle(values: FloatArray, beside: BoolArray) -> FloatArray:
    """Return the medians (M,) of those `values` (M,) that are `beside` (M, M) each and known; NaN for none."""
    table = np.where(beside, values, np.nan)
    table[~np.isfinite(table).any(axis=1)] = np.nan
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)
        middle: FloatArray = np.nanmedian(table, axis=1)
    return middle


def _beside_the_way_out(
    image: GreyImage, geometry: Geometry, fit: EdgeFit, who: IntArray, which: IntArray
) -> tuple[FloatArray, FloatArray]:
    """Return the brightness on both sides of the way out from corner `who` at its end `which`, (M, steps) each, NaN
    outside the image."""
    outwards = OUTWARDS[which][:, None] * STEPS_SQUARES[:, None]
    across = LATERAL_SQUARES * OUTWARDS[which][:, None, ::-1]
    cells = np.stack([outwards + across, outwards - across])
    places = fit.pixels[who, None] + np.einsum("ankc,ncp->ankp", cells, geometry.sides[who])
    inside = ((places >= 0.0) & (places <= np.array(image.shape[::-1]) - 1.0)).all(axis=3)
    one, other = np.where(inside, sample(image, places), np.nan)
    return one, other


def _end(differs: FloatArray) -> tuple[FloatArray, BoolArray]:
    """Return where (M,), in squares, the relative differences (M, steps) end, and which of them do."""
    k, far = np.arange(len(differs)), np.arange(len(STEPS_SQUARES))
    near = np.where(np.isfinite(differs) & (STEPS_SQUARES < FIRST), np.abs(differs), -1.0)
    peak = near.argmax(axis=1)
    differs = differs * np.sign(differs[k, peak])[:, None]
    over = (differs < 0.5) & (far > peak[:, None])
    at = np.maximum(over.argmax(axis=1), 1)
    before, after = differs[k, at - 1], differs[k, at]
    end: FloatArray = STEPS_SQUARES[at] - (0.5 - after) / np.maximum(before - after, 1e-9) * (
        STEPS_SQUARES[1] - STEPS_SQUARES[0]
    )
    goes_on = ((differs < GOES_ON) & (far > at[:, None])).any(axis=1)
    return end, over.any(axis=1) & (end < LAST) & ~(goes_on & (end > CUT))
