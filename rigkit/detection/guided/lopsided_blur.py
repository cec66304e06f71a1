"""The uncertainty of corners whose blur may be lopsided.

The edge model assumes symmetric blur. Coma, motion of uneven speed and the sharpening in cameras are not symmetric: the
place of a corner then depends on the blur. Neighbouring corners move alike, so that neither residuals nor the scatter
of corners show it. But further blur, although symmetric, moves them again, and as the noise of neighbours is
independent, the mean product of their moves is the variance of the common part.

Blur is assumed to move corners by independent amounts of equal variance for each octave of s. The octaves that are
added give the variance of an octave, and with it that of the octaves between a sharp image and this one.
"""

from __future__ import annotations

import cv2
import numpy as np

from rigkit.core.arrays import FloatArray, known_median
from rigkit.core.boards import Board
from rigkit.detection.guided.corner_fit import RADIUS_PX, fit_corners
from rigkit.detection.lattice.local_fit import fit_cells
from rigkit.detection.saddles.response import GreyImage
from rigkit.detection.subpixel.edge_curvature import line_curvatures_to_fit
from rigkit.detection.subpixel.edge_fit import BLUR_RANGE
from rigkit.detection.subpixel.refined import RefinedLattice
from rigkit.detection.subpixel.uncertain_corners import uncertain

OUT_OF_FOCUS_PX = 1.0
"""Smallest s, px, of an image out of focus: in others the square of the pixel, which is symmetric, is much of it."""

MIN_SQUARE_BLURS = 6.0
"""Smallest squares, in s after adding blur: in smaller ones the windows show mainly other corners."""

MIN_OCTAVES = 0.3
"""Smallest number of octaves that are added: with less, moves of corners by noise exceed those by the blur."""

MIN_PRODUCTS = 16
"""Smallest number of corners, and of pairs of neighbours."""

SIGNIFICANT = 3.0
"""Smallest ratio of the mean product of moves to its standard error: of 18 RENDERED boards, whose blur is symmetric, it
is at most 2.1; of REAL ones with excessive errors 4.7 to 18.7, of the others at most 1.4."""


def blur_shift_px(image: GreyImage, refined: RefinedLattice, board: Board) -> float:
    """Return the standard deviation, px per axis, of the common shift of a board's corners by lopsided blur.

    It is 0 in focus, and where too few corners or too small squares do not show it. `image` shows `board`, without
    markers.
    """
    lattice = refined.lattice
    known = lattice.known & ~uncertain(refined.sigma_px)
    # What covers missing corners blurs into the windows of those beside them.
    known &= cv2.dilate((~known).astype(np.uint8), np.ones((3, 3), np.uint8)) == 0
    if np.count_nonzero(known) < MIN_PRODUCTS:
        return 0.0
    shape, blur = fit_cells(lattice.pixels, known), known_median(refined.blur_px[known])
    wider = min(2.0 * blur, BLUR_RANGE[1], float(np.median(shape.gaps())) / MIN_SQUARE_BLURS)
    if blur < OUT_OF_FOCUS_PX or wider < 2.0**MIN_OCTAVES * blur:
        return 0.0
    curvatures = line_curvatures_to_fit(lattice.pixels, refined.sigma_px, known, shape.sides, RADIUS_PX)
    start, signs = lattice.pixels[known], lattice.signs()[known]
    added = wider**2 - blur**2
    more = np.asarray(cv2.GaussianBlur(image.astype(np.float32), (0, 0), float(np.sqrt(added))), np.float32)
    first, second = (
        fit_corners(picture, board, known, shape, start, signs, s, curvatures)
        for picture, s in ((image, blur), (more, wider))
    )
    moves = np.full(lattice.pixels.shape, np.nan)
    both = (first.valid & second.valid & (first.contrast > 0.0))[:, None]
    if np.count_nonzero(both) < MIN_PRODUCTS:
        return 0.0
    # Symmetric blur moves what light of a relative gradient g falls on by -g times its variance, towards the dark.
    gradient = relative_gradient(start, np.where(both[:, 0], first.contrast, np.nan))
    moves[known] = np.where(both, second.pixels - first.pixels + added * gradient, np.nan)
    return float(np.sqrt(common_variance(moves) * np.log(blur / BLUR_RANGE[0]) / np.log(wider / blur)))


def common_variance(moves: FloatArray) -> float:
    """Return the variance per axis of the common part of the moves (R, C, 2), NaN where unknown; 0 if it is not
    significant."""
    products = np.concatenate([(moves[1:] * moves[:-1]).ravel(), (moves[:, 1:] * moves[:, :-1]).ravel()])
    products = products[np.isfinite(products)]
    count = len(products)
    if count < 2 * MIN_PRODUCTS:
        return 0.0
    variance = float(products.mean())
    return variance if variance * np.sqrt(count) > SIGNIFICANT * float(products.std()) else 0.0


def relative_gradient(pixels: FloatArray, contrast: FloatArray) -> FloatArray:
    """Return the relative gradient (N, 2), 1/px, of the light at `pixels` (N, 2), from the contrast (N,) of corners
    there, NaN where unknown: that of a quadratic polynomial in its logarithm."""
    centre, scale = pixels.mean(axis=0), float(pixels.std())
    x, y = ((pixels - centre) / scale).T
    one, zero, seen = np.ones(len(x)), np.zeros(len(x)), np.isfinite(contrast)
    terms = np.stack([one, x, y, x * x, x * y, y * y], axis=1)
    fitted = np.linalg.lstsq(terms[seen], np.log(contrast[seen]), rcond=None)[0]
    slopes = np.stack([[zero, one, zero, 2.0 * x, y, zero], [zero, zero, one, zero, x, 2.0 * y]])
    return np.asarray((fitted @ slopes).T / scale)
