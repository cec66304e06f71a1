"""Completion of known boards: missed corners are predicted and fitted, and with a camera all corners are fitted again.

The size of the board determines which corners are missing. Their positions and lines are predicted by a calibrated
camera and the board's pose, or by neighbouring corners. A fit of the edge model there is accepted if its contrast has
the right sign, its residual is like that of its neighbours, and its position agrees with the prediction. Covered
corners remain missing.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray

from rigkit.cameras.base import Camera
from rigkit.core.arrays import BoolArray, FloatArray, known_median
from rigkit.core.boards import Board
from rigkit.core.detections import BoardDetection
from rigkit.core.patterns.charuco import Charuco
from rigkit.core.patterns.chessboard import Chessboard
from rigkit.detection.guided.board_guide import MAX_RESIDUAL_RATIO, MIN_GUIDE_CORNERS, BoardState, Guide
from rigkit.detection.guided.corner_fit import RADIUS_PX, fit_corners
from rigkit.detection.lattice.lattice import Lattice
from rigkit.detection.lattice.local_fit import LocalFit, fit_cells
from rigkit.detection.saddles.response import GreyImage, grey_image
from rigkit.detection.subpixel.consistent import MOVED_CELLS
from rigkit.detection.subpixel.correlation import with_uneven
from rigkit.detection.subpixel.edge_curvature import line_curvatures_to_fit
from rigkit.detection.subpixel.edge_fit import EdgeFit
from rigkit.detection.subpixel.refined import RefinedLattice
from rigkit.detection.subpixel.scatter import UNEXPLAINED_SCATTER
from rigkit.detection.subpixel.subpixel import FIRST_BLUR
from rigkit.detection.subpixel.uncertain_corners import IN_PLACE_CELLS, UNCERTAIN_FACTOR, uncertain_outliers
from rigkit.detection.subpixel.whole_board import placed_together
from rigkit.optim.robust_scale import MEDIAN_OF_RAYLEIGH

WIDE_BLUR_CELLS = 0.05
"""Initial s of the first fit of a missing corner, in sides of the cell: about the error of predictions."""

MIN_SIDE_PX = 4.0
"""Smallest side of a cell in which a corner is distinguishable from noise."""

MARGIN_PX = 1.5
"""Smallest distance of an added corner from the image border."""

MOVED_FACTOR, MOVED_PX = 8.0, 0.3
"""Largest distance of an added corner from its prediction with a camera, if less than MOVED_CELLS: MOVED_FACTOR times
the median distance of the known corners, but at least MOVED_PX."""

OUTLIER_GUIDE_FACTOR = 5.0
"""Largest distance of a corner from its prediction by camera and neighbours, over the median distance and its own
standard deviation combined; a partly covered corner exceeds it."""

SCATTER_FLOOR_PX = 0.01
"""Lower bound of the median distance, due to imperfect calibrations and boards."""


MIN_ADDED_CONTRAST = 0.15
"""Smallest contrast of an added corner over that of its neighbours: a glint reduces it strongly."""

MAX_ADDED_RESIDUAL, MAX_ADDED_RESIDUAL_ALONE = 1.6, 1.3
"""Largest residual of an added corner, in grey levels, over that of its neighbours, with and without a camera: other
objects in the window increase it."""

MAX_ADDED_RESIDUAL_MARKED = 3.0
"""The same on ChArUco boards, where the part of the markers in the windows varies."""

MAX_UNEXPLAINED, UNEXPLAINED_FACTOR = 0.25, 3.0
"""Residual in parts of the corner's contrast, of its neighbours' too where that is more (ink of markers): where one of
the four squares is missing, at the end of the paper or under a cover, it is 0.3 and more."""

MAX_SIGMA_CELLS = 0.03
"""Largest predicted standard deviation of an added corner, in sides of the cell."""


def complete_boards(
    image: NDArray[np.generic],
    detections: Sequence[BoardDetection],
    boards: Sequence[Board],
    camera: Camera | None = None,
) -> tuple[BoardDetection, ...]:
    """Return `detections` with missed corners added, in the same order.

    Parameters
    ----------
    image : the image of the detections, as for `rigkit.detect_boards`.
    detections : those of a listed size are completed; others are returned unchanged.
    boards : the boards that may be in the image.
    camera : the calibrated camera, if known. It predicts corners far from the detected ones. All corners are fitted
        again with windows and lines from its projection, and corners that contradict it are dropped. It is ignored if
        no pose of the board fits the detected corners.

    Raises
    ------
    InputError
        `image` is not an image of a supported type.
    """
    grey = grey_image(image)
    return tuple(completed(grey, found, boards, camera) for found in detections)


def completed(grey: GreyImage, found: BoardDetection, boards: Sequence[Board], camera: Camera | None) -> BoardDetection:
    """Return one detection completed as by `complete_boards`, from an image in grey levels."""
    board = _board_of(found, boards)
    if board is None or len(found.grid) < MIN_GUIDE_CORNERS or (camera is None and found.complete):
        return found
    return _completed(grey, found, board, camera)


def _board_of(found: BoardDetection, boards: Sequence[Board]) -> Board | None:
    """Return a board with the detection's size, the one with its id if it has one; None if there is none."""
    fitting = [
        b for b in boards if b.size == (found.columns, found.rows) and isinstance(b.pattern, Chessboard | Charuco)
    ]
    named = [b for b in fitting if b.board_id == found.board_id]
    return next(iter(named or [b for b in fitting if not b.identified]), None)


def _completed(image: GreyImage, found: BoardDetection, board: Board, camera: Camera | None) -> BoardDetection:
    first = _fit_of_detected(image, found, board)
    if first is None:
        return found
    state = first
    guide = Guide.of(board, camera, state)
    if guide.camera is not None:
        state = _fitted_and_checked(image, guide, state)
    before = state
    while (more := _with_next_corners(image, guide := guide.by(state), state)) is not None:
        state = more
    if guide.camera is None:
        return found if state is before else _with_added(image, guide, found, first, state)
    if state is not before:
        state = _fitted_and_checked(image, guide, state)
    state = state.without(~np.isfinite(state.sigma_px))
    row, column = np.nonzero(state.known)
    if len(row) < MIN_GUIDE_CORNERS:
        return found
    # The factor of correlated noise is applied only if it reduces sigmas; larger ones follow from the scatter.
    alike = state if state.jointly else first
    state = replace(state, sigma_px=min(1.0, _detector_factor(found, alike)) * state.sigma_px)
    sigma = _scatter_factor(guide, state) * state.sigma_px[row, column]
    return replace(found, grid=np.stack([column, row], axis=-1), pixels=state.pixels[row, column], sigma_px=sigma)


def _with_added(
    image: GreyImage, guide: Guide, found: BoardDetection, first: BoardState, state: BoardState
) -> BoardDetection:
    """Return `found` with the additional corners of `state` that do not contradict the others."""
    state = _fitted_jointly(
        image, guide.board, _fitted_with_neighbours(image, guide.board, state, state.known & ~first.known)
    )
    added = state.known & ~first.known & (_excess_distances(guide, state, state) <= 1.0)
    added &= ~_uncertain_outliers(state)
    sigma = _detector_factor(found, state if state.jointly else first) * state.sigma_px
    row, column = np.nonzero(added)
    grid = np.concatenate([found.grid, np.stack([column, row], axis=-1)])
    order = np.lexsort((grid[:, 0], grid[:, 1]))
    return replace(
        found,
        grid=grid[order],
        pixels=np.concatenate([found.pixels, state.pixels[row, column]])[order],
        sigma_px=np.concatenate([found.sigma_px, sigma[row, column]])[order],
    )


def _uncertain_outliers(state: BoardState) -> BoolArray:
    """Return which corners of `state` are uncertain and contradict their predictions by the others."""
    known = state.known
    shape = fit_cells(state.pixels, known, leave_out=True)
    off, gain = np.full((2, *known.shape), np.nan)
    off[known] = np.linalg.norm(state.pixels[known] - shape.pixels, axis=1) / shape.cell_px()
    gain[known] = shape.gain
    return uncertain_outliers(state.sigma_px, off, gain)


def _fitted_with_neighbours(image: GreyImage, board: Board, state: BoardState, cells: BoolArray) -> BoardState:
    """Return the state with the `cells` fitted again, after corners around them were added."""
    if not cells.any():
        return state
    known = state.known & np.isfinite(state.sigma_px)
    shape = fit_cells(state.pixels, known)
    curvatures = line_curvatures_to_fit(state.pixels, state.sigma_px, known, shape.sides, RADIUS_PX)
    blur = known_median(state.blur)
    fit = fit_corners(image, board, known, shape, state.pixels[known], state.signs[known], blur, curvatures)
    fit = _with_correlated_noise(fit, shape.sides, board)
    return state.with_fit(known, fit, fit.valid & (fit.contrast > 0.0) & cells[known])


def _with_correlated_noise(fit: EdgeFit, sides: FloatArray, board: Board) -> EdgeFit:
    return with_uneven(fit, sides, RADIUS_PX, marked=isinstance(board.pattern, Charuco))[0]


def _detector_factor(found: BoardDetection, state: BoardState) -> float:
    """Return the median factor by which the detector multiplied its sigmas, for scatter and correlated noise.

    `state` : the same corners, fitted separately or jointly as by the detector.
    """
    return known_median(found.sigma_px / state.sigma_px[found.grid[:, 1], found.grid[:, 0]])


def _scatter_factor(guide: Guide, state: BoardState) -> float:
    """Return the ratio of the corners' scatter about their predictions to their sigmas; 1 if not significant."""
    cells = state.known
    shape, seen = guide.at(state, cells)
    if not seen.any():
        return 1.0
    off = np.linalg.norm(state.pixels[cells] - shape.pixels, axis=1)
    ratio = float(np.median((off / (state.sigma_px[cells] * shape.gain))[seen])) / MEDIAN_OF_RAYLEIGH
    return ratio if ratio > UNEXPLAINED_SCATTER else 1.0


def _fit_of_detected(image: GreyImage, found: BoardDetection, board: Board) -> BoardState | None:
    """Return the fit results of the detected corners; None if there are too few valid ones."""
    shape = (found.rows, found.columns)
    signs = np.where(np.add.outer(np.arange(shape[0]), np.arange(shape[1])) % 2 == 1, -1.0, 1.0)
    state = BoardState.unfitted(found.lattice(), signs)
    cells = state.known
    if not (cells.any(axis=0).sum() >= 3 and cells.any(axis=1).sum() >= 3):
        return None
    local = fit_cells(state.pixels, cells)
    fit = fit_corners(image, board, cells, local, state.pixels[cells], signs[cells], FIRST_BLUR)
    if np.median(fit.contrast) < 0.0:
        state = replace(state, signs=-signs)
    # A second fit, as the residual is meaningful only with a converged blur.
    blur = float(np.median(fit.blur))
    fit = fit_corners(image, board, cells, local, state.pixels[cells], state.signs[cells], blur)
    good = fit.valid & (fit.contrast > 0.0)
    if good.sum() < MIN_GUIDE_CORNERS:
        return None
    # Positions remain those of the detector.
    first = state.with_fit(cells, fit, good)
    return replace(first, pixels=state.pixels)


def _with_next_corners(image: GreyImage, guide: Guide, state: BoardState) -> BoardState | None:
    """Return the state with the missing corners that can be added now, None if there are none."""
    missing = ~state.known
    if not missing.any():
        return None
    shape, predicted = guide.at(state, missing)
    side = shape.shorter_px()
    height, width = image.shape
    with np.errstate(invalid="ignore"):
        inside = (shape.pixels > MARGIN_PX) & (shape.pixels < np.array([width, height]) - 1.0 - MARGIN_PX)
        usable = predicted & inside.all(axis=1) & (side > MIN_SIDE_PX)
        usable &= shape.areas() > 0.25 * side**2
    if not usable.any():
        return None
    cells = missing.copy()
    cells[missing] = usable
    shape = shape.of(usable)
    side = side[usable]
    blur = known_median(state.blur)
    signs = state.signs[cells]
    wide = np.maximum(blur, WIDE_BLUR_CELLS * side)
    rough = fit_corners(image, guide.board, cells, shape, shape.pixels, signs, wide)
    start = np.where(rough.valid[:, None], rough.pixels, shape.pixels)
    fit = fit_corners(image, guide.board, cells, shape, start, signs, blur)
    good = _is_confirmed(guide, state, cells, shape, side, fit)
    return state.with_fit(cells, fit, good) if good.any() else None


def _is_confirmed(
    guide: Guide, state: BoardState, cells: BoolArray, shape: LocalFit, side: FloatArray, fit: EdgeFit
) -> BoolArray:
    """Return which of the corners fitted at `cells` of geometry `shape` (M,) are confirmed."""
    known = state.known
    moved = np.linalg.norm(fit.pixels - shape.pixels, axis=1)
    limit = MOVED_CELLS * side
    if guide.camera is not None:
        typical = float(np.median(np.linalg.norm(state.pixels[known] - guide.at(state, known)[0].pixels, axis=1)))
        limit = np.minimum(limit, np.maximum(MOVED_FACTOR * typical * shape.gain, MOVED_PX))
    contrast, residual, sigma_px = state.typical_near(cells)
    good = fit.valid & (moved < limit) & (fit.contrast > MIN_ADDED_CONTRAST * contrast)
    # Noise is independent of the contrast, model errors grow with it.
    most = MAX_ADDED_RESIDUAL if guide.camera is not None else MAX_ADDED_RESIDUAL_ALONE
    most = MAX_ADDED_RESIDUAL_MARKED if isinstance(guide.board.pattern, Charuco) else most
    good &= fit.residual < most * residual * np.maximum(1.0, fit.contrast / contrast)
    good &= fit.sigma_px < MAX_SIGMA_CELLS * side
    good &= fit.residual < np.maximum(MAX_UNEXPLAINED, UNEXPLAINED_FACTOR * residual / contrast) * fit.contrast
    # What is unsure leads to more of its like: on a cover with a texture, ring by ring.
    good &= (fit.sigma_px < UNCERTAIN_FACTOR * sigma_px) | (moved < IN_PLACE_CELLS * side)
    return np.asarray(good)


def _fitted_with_guide(image: GreyImage, guide: Guide, state: BoardState) -> BoardState:
    """Return the state with every corner fitted again with the geometry predicted by the camera."""
    cells = state.known.copy()
    shape, seen = guide.at(state, cells)
    # Corners whose neighbourhood is beyond the lens model's field of view are not fitted again.
    cells[cells] = seen
    if not seen.any():
        return state
    blur = known_median(state.blur)
    fit = fit_corners(image, guide.board, cells, shape.of(seen), state.pixels[cells], state.signs[cells], blur)
    fit = _with_correlated_noise(fit, shape.sides[seen], guide.board)
    return replace(state.with_fit(cells, fit, fit.valid & (fit.contrast > 0.0)), jointly=False)


def _fitted_jointly(image: GreyImage, board: Board, state: BoardState) -> BoardState:
    """Return the state with its corners fitted jointly if the blur requires it (`placed_together`).

    Corners of ChArUco boards are not: with markers their squares are not uniform.
    """
    if isinstance(board.pattern, Charuco):
        return state
    # Failed fits have neither blur nor sigma.
    state = state.without(~np.isfinite(state.sigma_px) | ~np.isfinite(state.blur))
    lattice = Lattice(state.pixels, state.contrast, bool(state.signs[0, 0] > 0.0))
    alone = RefinedLattice(lattice, state.sigma_px, state.blur, state.residual, state.noise)
    placed = placed_together(image, alone)
    if placed is alone:
        return state
    return replace(state, pixels=placed.lattice.pixels, sigma_px=placed.sigma_px, jointly=True)


def _fitted_and_checked(image: GreyImage, guide: Guide, state: BoardState) -> BoardState:
    """Return the state with every corner fitted again, without those that contradict the camera and the others."""
    again = _fitted_with_guide(image, guide, state)
    state = _fitted_jointly(image, guide.board, again)
    kept = _without_contradicting(guide, state)
    if not state.jointly or np.array_equal(kept.known, state.known):
        return kept
    # Dropped corners affected the joint fit of the others.
    return _fitted_jointly(image, guide.board, again.without(~kept.known))


def _without_contradicting(guide: Guide, state: BoardState) -> BoardState:
    """Return the state without the corners that contradict the camera and their neighbours.

    The worst are dropped first, as they affect the predictions of their neighbours.
    """
    rest = state
    while True:
        share = _excess_distances(guide, rest, rest)
        outlying = (share > 1.0) & (share >= cv2.dilate(share, np.ones((5, 5))))
        if not outlying.any():
            break
        rest = rest.without(outlying)
        guide = guide.by(rest)
    return state.without(_excess_distances(guide, state, rest) > 1.0)


def _excess_distances(guide: Guide, state: BoardState, predicting: BoardState) -> FloatArray:
    """Return the distances (R, C) of the corners of `state` from predictions by `predicting`, over the allowed ones."""
    cells, own = state.known, predicting.known
    off = np.zeros(cells.shape)
    shape, _ = guide.at(predicting, cells)
    # NaN beyond the lens model's field of view counts as 0.
    off[cells] = np.nan_to_num(np.linalg.norm(state.pixels[cells] - shape.pixels, axis=1) / np.maximum(shape.gain, 1.0))
    typical = max(float(np.median(off[own])), SCATTER_FLOOR_PX) if own.any() else SCATTER_FLOOR_PX
    sigma = np.minimum(np.where(cells, state.sigma_px, 1.0), MAX_RESIDUAL_RATIO * state.typical_sigma)
    allowed = OUTLIER_GUIDE_FACTOR * np.hypot(typical, sigma)
    return np.where(cells, off / allowed, 0.0)
