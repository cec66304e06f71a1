"""The edge model at corners of a board that is known: where it ends, and what is between its corners."""

from __future__ import annotations

import numpy as np

from rigkit.core.arrays import BoolArray, FloatArray
from rigkit.core.boards import Board
from rigkit.core.patterns.charuco import Charuco
from rigkit.core.patterns.chessboard import Chessboard
from rigkit.detection.lattice.local_fit import LocalFit
from rigkit.detection.saddles.response import GreyImage
from rigkit.detection.subpixel.edge_fit import BLUR_RANGE, EdgeFit, fit_edges
from rigkit.detection.subpixel.edge_model import NEAR_PX, NEAR_SIGMAS, Geometry, ends_of
from rigkit.detection.subpixel.outer_squares import fitted_beside_paper

RADIUS_PX, FIT_STEPS = 18.0, 8
"""Radius of the window and Gauss-Newton steps, as in the last pass of `rigkit.detection.subpixel.subpixel`."""

MIN_NOISE_LEFT = 1e-9
"""Of a fit that failed there is none."""

MARKER_BLURS = 2.0
"""The edges of a ChArUco board's markers reach so many s towards the corners."""


def fit_corners(
    image: GreyImage,
    board: Board,
    cells: BoolArray,
    shape: LocalFit,
    start: FloatArray,
    signs: FloatArray,
    blur: FloatArray | float,
    curvatures: tuple[FloatArray, FloatArray] | None = None,
    *,
    paper: bool = True,
) -> EdgeFit:
    """Fit the edge model to the M `cells` (R, C) of `board` from `start` (M, 2); `shape` is theirs.

    `signs` (M,) as `Lattice.signs`; `blur` is the s expected; `curvatures` are those of the lines and how well they are
    known, (M, 2) each, where corners' sigmas tell more of them than `shape`. Windows end before the markers of ChArUco
    boards. `paper` : read what lies beyond the board.
    """
    curvature, loose = curvatures or (shape.curvature(), np.zeros((len(start), 2)))
    every = Geometry(shape.sides, curvature, shape.gaps(), ends_of(np.ones_like(cells), cells))
    width = _short_of_markers(board, shape.sides, np.broadcast_to(np.asarray(blur, dtype=np.float64), (len(start),)))

    def fitted(which: BoolArray | slice, geometry: Geometry) -> EdgeFit:
        return fit_edges(
            *(image, start[which], geometry, signs[which], width[which]),
            radius_px=RADIUS_PX,
            iterations=FIT_STEPS,
            curvature_sigma=loose[which],
        )

    fit = fitted(slice(None), every)
    if paper and isinstance(board.pattern, Chessboard):
        fit = fitted_beside_paper(image, every, fit, fitted, signs, np.zeros(len(start), np.int64))
    if isinstance(board.pattern, Charuco):
        # What markers leave in the windows is no noise, but makes the corners uncertain all the same.
        fit = fit.less_sure(fit.residual / np.maximum(fit.noise, MIN_NOISE_LEFT), all_is_noise=True)
    return fit


def _short_of_markers(board: Board, sides: FloatArray, blur: FloatArray) -> FloatArray:
    """Return the s (M,) to start from, so small that the windows, a few s to either side of a line, are narrow."""
    if isinstance(board.pattern, Charuco):
        gap = gap_to_markers(board, sides)
        blur = np.minimum(blur, (gap - MARKER_BLURS * blur - NEAR_PX) / NEAR_SIGMAS)
    return np.clip(blur, *BLUR_RANGE)


def gap_to_markers(board: Board, sides: FloatArray) -> FloatArray:
    """Return how far it is (N,), px, from the lines of a ChArUco `board` to its markers; `sides` (N, 2, 2) are px."""
    assert isinstance(board.pattern, Charuco)
    white = 0.5 * (1.0 - board.pattern.marker_mm / np.array(board.squares_mm))
    return np.asarray((white * np.linalg.norm(sides, axis=2)).min(axis=1))
