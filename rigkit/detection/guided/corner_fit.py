"""Fits of the edge model at corners of a known board, with its borders and markers."""

from __future__ import annotations

import numpy as np

from rigkit.core.arrays import BoolArray, FloatArray
from rigkit.core.boards import Board
from rigkit.core.patterns.charuco import Charuco
from rigkit.core.patterns.chessboard import Chessboard
from rigkit.detection.lattice.local_fit import LocalFit
from rigkit.detection.saddles.response import GreyImage
from rigkit.detection.subpixel.edge_fit import BLUR_RANGE, EdgeFit, fit_edges
from rigkit.detection.subpixel.edge_model import NEAR_PX, TAIL_SIGMAS, Geometry, ends_of
from rigkit.detection.subpixel.outer_squares import fitted_beside_paper

RADIUS_PX, FIT_STEPS = 18.0, 8
"""Radius of the window and Gauss-Newton steps, as in the last pass of `rigkit.detection.subpixel.subpixel`."""

MIN_NOISE_LEFT = 1e-9
"""Lower bound of the noise, which is 0 for failed fits."""

MARKER_BLURS = 2.0
"""Extent of the blur of a ChArUco board's markers, in s."""


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
    """Return the fits of the edge model at the M `cells` (R, C) of `board`, with geometry `shape`, from `start` (M, 2).

    `signs` (M,) as `Lattice.signs`; `blur` is the expected s; `curvatures` of the lines and their standard deviations,
    (M, 2) each, replace those of `shape`. Windows exclude the markers of ChArUco boards. `paper` : model the image
    beyond the board.
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
        # Residuals due to markers in the windows are no noise, but affect the corners: all residuals count.
        fit = fit.with_sigma_factors(fit.residual / np.maximum(fit.noise, MIN_NOISE_LEFT), all_is_noise=True)
    return fit


def _short_of_markers(board: Board, sides: FloatArray, blur: FloatArray) -> FloatArray:
    """Return the initial s (M,), reduced so that windows, a few s to either side of a line, exclude markers."""
    if isinstance(board.pattern, Charuco):
        gap = gap_to_markers(board, sides)
        blur = np.minimum(blur, (gap - MARKER_BLURS * blur - NEAR_PX) / TAIL_SIGMAS)
    return np.clip(blur, *BLUR_RANGE)


def gap_to_markers(board: Board, sides: FloatArray) -> FloatArray:
    """Return the distances (N,), px, from the lines of a ChArUco `board` to its markers; `sides` (N, 2, 2) are px."""
    assert isinstance(board.pattern, Charuco)
    white = 0.5 * (1.0 - board.pattern.marker_mm / np.array(board.squares_mm))
    return np.asarray((white * np.linalg.norm(sides, axis=2)).min(axis=1))
