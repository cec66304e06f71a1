"""A second look at boards that are known: where corners are still missing, and where all of them are exactly.

A board of known size says which corners there should be, a calibrated camera where (from the board's pose), and how the
lines through them run and bend; without a camera the corners around say so. The edge model is fitted there; what it
finds counts by the same evidence as any corner: contrast of the right sign, a residual like that of its neighbours, and
a place where the prediction has it. What something covers stays missing.
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
from rigkit.detection.subpixel.correlation import shared_noise, with_uneven
from rigkit.detection.subpixel.edge_curvature import line_curvatures_to_fit
from rigkit.detection.subpixel.edge_fit import EdgeFit
from rigkit.detection.subpixel.refined import RefinedLattice
from rigkit.detection.subpixel.scatter import UNEXPLAINED
from rigkit.detection.subpixel.uncertain_corners import strays
from rigkit.detection.subpixel.whole_board import placed_together
from rigkit.optim.robust_scale import MEDIAN_OF_RAYLEIGH

START_BLUR_PX = 1.0
"""s that the first fit of the corners found starts from, px."""

WIDE_BLUR_CELLS = 0.05
"""A missing corner is first sought with edges so wide, in sides of the cell: they reach as far as predictions err."""

MAX_GUIDE_ROUNDS = 40
"""Rounds of adding at most, without a camera one ring of corners each: more than any board has rows or columns."""

MIN_SIDE_PX = 4.0
"""Corners of smaller cells are not told from noise."""

MARGIN_PX = 1.5
"""Corners nearer to the frame have no pixels on all sides."""

MOVED_CELLS = 0.12
MOVED_FACTOR = 8.0
MOVED_PX = 0.3
"""How far a corner may lie from its prediction: in sides of its cell; where a camera predicts, also times what the
found corners lie off theirs, but this many px in any case."""

OUTLIER_GUIDE_FACTOR = 5.0
"""A corner that lies off where the camera and the corners around have it by more than this, times what is usual and its
own standard deviation together, is covered in part."""

SCATTER_FLOOR_PX = 0.01
"""No camera and no printed board is truer than this."""


MIN_ADDED_CONTRAST = 0.15
"""Contrast relative to the found corners' around: a glint takes most of it, but not all."""

MAX_ADDED_RESIDUAL, MAX_ADDED_RESIDUAL_ALONE = 1.6, 1.3
"""Residual in grey levels relative to that of the found corners, with and without a camera that says where the corner
is: pixels of another thing raise it."""

MAX_ADDED_RESIDUAL_MARKED = 3.0
"""The same on ChArUco boards, where what the windows see of the markers differs from corner to corner."""

MAX_SIGMA_CELLS = 0.03
"""Largest predicted standard deviation, in sides of the cell."""


def complete_boards(
    image: NDArray[np.generic],
    detections: Sequence[BoardDetection],
    boards: Sequence[Board],
    camera: Camera | None = None,
) -> tuple[BoardDetection, ...]:
    """Return `detections` with the corners added that were missed, in the same order.

    Parameters
    ----------
    image : what the detections were found in; as for `rigkit.detect_boards`.
    detections : of these, boards of a listed size are completed; others come back as they are.
    boards : the boards that may be in the image.
    camera : the calibrated camera, if known. It predicts corners far from those found, and all corners are fitted anew
        with windows and lines as it sees them; corners that contradict it are dropped. Where no pose of the board
        explains the corners found, it is left aside.

    Raises
    ------
    InputError
        `image` is not an image of a supported type.
    """
    grey = grey_image(image)
    return tuple(completed(grey, found, boards, camera) for found in detections)


def completed(grey: GreyImage, found: BoardDetection, boards: Sequence[Board], camera: Camera | None) -> BoardDetection:
    """Return one detection as `complete_boards` does, from an image in grey levels."""
    board = _board_of(found, boards)
    if board is None or len(found.grid) < MIN_GUIDE_CORNERS or (camera is None and found.complete):
        return found
    return _completed(grey, found, board, camera)


def _board_of(found: BoardDetection, boards: Sequence[Board]) -> Board | None:
    """Return a board of the detection's grid, the one it names if it names one."""
    fitting = [
        b for b in boards if b.size == (found.columns, found.rows) and isinstance(b.pattern, Chessboard | Charuco)
    ]
    named = [b for b in fitting if b.board_id == found.board_id]
    return next(iter(named or [b for b in fitting if not b.identified]), None)


def _completed(image: GreyImage, found: BoardDetection, board: Board, camera: Camera | None) -> BoardDetection:
    opened = _opened(image, found, board)
    if opened is None:
        return found
    state = opened
    guide = Guide.of(board, camera, state)
    if guide.camera is not None:
        state = _tested(image, guide, state)
    before = state
    for _ in range(MAX_GUIDE_ROUNDS):
        guide = guide.by(state)
        more = _added(image, guide, state)
        if more is None:
            break
        state = more
    if guide.camera is None:
        return found if state is before else _with_added(image, guide, found, opened, state)
    if state is not before:
        state = _tested(image, guide, state)
    state = state.without(~np.isfinite(state.sigma_px))
    row, column = np.nonzero(state.known)
    if len(row) < MIN_GUIDE_CORNERS:
        return found
    # Noise that cancels from pixel to pixel lets sigmas be smaller; where they must be larger, the scatter shows it.
    alike = state if state.together else opened
    state = replace(state, sigma_px=min(1.0, _known_factor(found, alike)) * state.sigma_px)
    sigma = _scatter(guide, state) * state.sigma_px[row, column]
    return replace(found, grid=np.stack([column, row], axis=-1), pixels=state.pixels[row, column], sigma_px=sigma)


def _with_added(
    image: GreyImage, guide: Guide, found: BoardDetection, opened: BoardState, state: BoardState
) -> BoardDetection:
    """Return `found` with those corners of `state` that it has not, but for any that contradict the others."""
    state = _together(image, guide.board, _settled(image, guide.board, state, state.known & ~opened.known))
    added = state.known & ~opened.known & (_contradiction(guide, state, state) <= 1.0)
    added &= ~_strays(state)
    sigma = _known_factor(found, state if state.together else opened) * state.sigma_px
    row, column = np.nonzero(added)
    grid = np.concatenate([found.grid, np.stack([column, row], axis=-1)])
    order = np.lexsort((grid[:, 0], grid[:, 1]))
    return replace(
        found,
        grid=grid[order],
        pixels=np.concatenate([found.pixels, state.pixels[row, column]])[order],
        sigma_px=np.concatenate([found.sigma_px, sigma[row, column]])[order],
    )


def _strays(state: BoardState) -> BoolArray:
    """Return which corners of `state` are unsure, and not where the others have them."""
    known = state.known
    shape = fit_cells(state.pixels, known, leave_out=True)
    off, gain = np.full((2, *known.shape), np.nan)
    off[known] = np.linalg.norm(state.pixels[known] - shape.pixels, axis=1) / shape.cell_px()
    gain[known] = shape.gain
    return strays(state.sigma_px, off, gain)


def _settled(image: GreyImage, board: Board, state: BoardState, cells: BoolArray) -> BoardState:
    """Return the state with the `cells` fitted anew, now that there are corners around them on all sides."""
    if not cells.any():
        return state
    known = state.known & np.isfinite(state.sigma_px)
    shape = fit_cells(state.pixels, known)
    curvatures = line_curvatures_to_fit(state.pixels, state.sigma_px, known, shape.sides, RADIUS_PX)
    blur = known_median(state.blur)
    fit = fit_corners(image, board, known, shape, state.pixels[known], state.signs[known], blur, curvatures)
    fit = _with_uneven(fit, shape.sides, board)
    return state.with_fit(known, fit, fit.valid & (fit.contrast > 0.0) & cells[known])


def _with_uneven(fit: EdgeFit, sides: FloatArray, board: Board) -> EdgeFit:
    typical = shared_noise(fit, sides, RADIUS_PX, marked=isinstance(board.pattern, Charuco))
    return with_uneven(fit, sides, RADIUS_PX, typical)


def _known_factor(found: BoardDetection, state: BoardState) -> float:
    """Return the factor that the detector, which saw scatter and noise of the board as a whole, gave its sigmas.

    `state` : the same corners, placed as the detector has placed them: alone or together.
    """
    return known_median(found.sigma_px / state.sigma_px[found.grid[:, 1], found.grid[:, 0]])


def _scatter(guide: Guide, state: BoardState) -> float:
    """Return how much more the corners scatter about where camera and neighbours have them than their sigmas say."""
    cells = state.known
    shape, seen = guide.at(state, cells)
    if not seen.any():
        return 1.0
    off = np.linalg.norm(state.pixels[cells] - shape.pixels, axis=1)
    ratio = float(np.median((off / (state.sigma_px[cells] * shape.gain))[seen])) / MEDIAN_OF_RAYLEIGH
    return ratio if ratio > UNEXPLAINED else 1.0


def _opened(image: GreyImage, found: BoardDetection, board: Board) -> BoardState | None:
    """Return what the fit says of the corners found; None where they do not alternate like a chessboard's."""
    shape = (found.rows, found.columns)
    signs = np.where(np.add.outer(np.arange(shape[0]), np.arange(shape[1])) % 2 == 1, -1.0, 1.0)
    state = BoardState.unfitted(found.lattice(), signs)
    cells = state.known
    if not (cells.any(axis=0).sum() >= 3 and cells.any(axis=1).sum() >= 3):
        return None
    local = fit_cells(state.pixels, cells)
    fit = fit_corners(image, board, cells, local, state.pixels[cells], signs[cells], START_BLUR_PX)
    if np.median(fit.contrast) < 0.0:
        state = replace(state, signs=-signs)
    # Once more: the fit ends when the corner stands still, and its residual means something only with the right blur.
    blur = float(np.median(fit.blur))
    fit = fit_corners(image, board, cells, local, state.pixels[cells], state.signs[cells], blur)
    good = fit.valid & (fit.contrast > 0.0)
    if good.sum() < MIN_GUIDE_CORNERS:
        return None
    # The corners stay where the detector has put them: only what the fit says of them is taken.
    opened = state.with_fit(cells, fit, good)
    return replace(opened, pixels=state.pixels)


def _added(image: GreyImage, guide: Guide, state: BoardState) -> BoardState | None:
    """Return the state with those missing corners that can be added now, None where there are none."""
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
    good = _confirmed(guide, state, cells, shape, side, fit)
    return state.with_fit(cells, fit, good) if good.any() else None


def _confirmed(
    guide: Guide, state: BoardState, cells: BoolArray, shape: LocalFit, side: FloatArray, fit: EdgeFit
) -> BoolArray:
    """Return which of the corners fitted at `cells` of `shape` are what was predicted there."""
    known = state.known
    moved = np.linalg.norm(fit.pixels - shape.pixels, axis=1)
    limit = MOVED_CELLS * side
    if guide.camera is not None:
        typical = float(np.median(np.linalg.norm(state.pixels[known] - guide.at(state, known)[0].pixels, axis=1)))
        limit = np.minimum(limit, np.maximum(MOVED_FACTOR * typical * shape.gain, MOVED_PX))
    contrast, residual = state.typical_near(cells)
    good = fit.valid & (moved < limit) & (fit.contrast > MIN_ADDED_CONTRAST * contrast)
    # Noise is the same at any contrast; what the model gets wrong grows with it.
    most = MAX_ADDED_RESIDUAL if guide.camera is not None else MAX_ADDED_RESIDUAL_ALONE
    most = MAX_ADDED_RESIDUAL_MARKED if isinstance(guide.board.pattern, Charuco) else most
    good &= fit.residual < most * residual * np.maximum(1.0, fit.contrast / contrast)
    good &= fit.sigma_px < MAX_SIGMA_CELLS * side
    return np.asarray(good)


def _again(image: GreyImage, guide: Guide, state: BoardState) -> BoardState:
    """Return the state with every corner fitted anew as the camera sees it."""
    cells = state.known.copy()
    shape, seen = guide.at(state, cells)
    # At the end of a lens model's field a corner may be seen but not the half squares around it: it stays as it is.
    cells[cells] = seen
    if not seen.any():
        return state
    blur = known_median(state.blur)
    fit = fit_corners(image, guide.board, cells, shape.of(seen), state.pixels[cells], state.signs[cells], blur)
    fit = _with_uneven(fit, shape.sides[seen], guide.board)
    return replace(state.with_fit(cells, fit, fit.valid & (fit.contrast > 0.0)), together=False)


def _together(image: GreyImage, board: Board, state: BoardState) -> BoardState:
    """Return the state with its corners placed together where blur asks for it, as plain detection places them.

    A ChArUco board's stay as they are: with markers in them its squares are not even.
    """
    if isinstance(board.pattern, Charuco):
        return state
    # A corner whose own fit came to nothing has neither blur nor sigma.
    state = state.without(~np.isfinite(state.sigma_px) | ~np.isfinite(state.blur))
    lattice = Lattice(state.pixels, state.contrast, bool(state.signs[0, 0] > 0.0))
    alone = RefinedLattice(lattice, state.sigma_px, state.blur, state.residual, state.noise)
    placed = placed_together(image, alone)
    if placed is alone:
        return state
    return replace(state, pixels=placed.lattice.pixels, sigma_px=placed.sigma_px, together=True)


def _tested(image: GreyImage, guide: Guide, state: BoardState) -> BoardState:
    """Return the state with every corner fitted anew, without those that contradict the camera and the others."""
    again = _again(image, guide, state)
    state = _together(image, guide.board, again)
    kept = _unanimous(guide, state)
    if not state.together or np.array_equal(kept.known, state.known):
        return kept
    # What covers a corner had a say in where the others are.
    return _together(image, guide.board, again.without(~kept.known))


def _unanimous(guide: Guide, state: BoardState) -> BoardState:
    """Return the state without the corners that contradict the camera and the corners around them.

    Those that contradict the most go first: they may be all that speaks against their neighbours.
    """
    rest = state
    for _ in range(MAX_GUIDE_ROUNDS):
        share = _contradiction(guide, rest, rest)
        outlying = (share > 1.0) & (share >= cv2.dilate(share, np.ones((5, 5))))
        if not outlying.any():
            break
        rest = rest.without(outlying)
        guide = guide.by(rest)
    return state.without(_contradiction(guide, state, rest) > 1.0)


def _contradiction(guide: Guide, state: BoardState, judges: BoardState) -> FloatArray:
    """Return (R, C) how far each corner of `state` lies off where `judges` have it, 1 at most allowed; 0 for none."""
    cells, own = state.known, judges.known
    off = np.zeros(cells.shape)
    shape, _ = guide.at(judges, cells)
    # Where the lens model ends nothing is said.
    off[cells] = np.nan_to_num(np.linalg.norm(state.pixels[cells] - shape.pixels, axis=1) / np.maximum(shape.gain, 1.0))
    typical = max(float(np.median(off[own])), SCATTER_FLOOR_PX) if own.any() else SCATTER_FLOOR_PX
    sigma = np.minimum(np.where(cells, state.sigma_px, 1.0), MAX_RESIDUAL_RATIO * state.typical_sigma)
    allowed = OUTLIER_GUIDE_FACTOR * np.hypot(typical, sigma)
    return np.where(cells, off / allowed, 0.0)
