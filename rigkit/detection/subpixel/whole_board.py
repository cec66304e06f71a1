"""Joint fit of all corners of a board whose squares are small relative to the blur.

If edges extend over most of a square, a corner's window shows mainly the edges of other corners. The model is therefore
an image of the whole board: uniform squares, transformed by a smooth map through all corners, with slowly varying
light, and blurred. All corners are estimated jointly. With fewer unknowns per corner, their standard deviations are
smaller than those of separate windows.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import cv2
import numpy as np

from rigkit.core.arrays import BoolArray, FloatArray, known_median
from rigkit.detection.lattice.lattice import MIN_ROWS, Lattice
from rigkit.detection.lattice.local_fit import fit_cells, predicted
from rigkit.detection.saddles.response import GreyImage
from rigkit.detection.subpixel.board_window import BoardWindow, Surroundings, extended
from rigkit.detection.subpixel.edge_curvature import FREE
from rigkit.detection.subpixel.edge_fit import BLUR_RANGE, MAX_BLUR_CHANGE, MAX_MOVE_PX, ROUNDING_VARIANCE
from rigkit.detection.subpixel.edge_model import WINDOW_REACH, Geometry, ends_of
from rigkit.detection.subpixel.outer_squares import MAX_PAPER, outer_squares
from rigkit.detection.subpixel.refined import RefinedLattice
from rigkit.detection.subpixel.scatter import scatter_factors
from rigkit.kernels.boards import (
    Blocks,
    Picture,
    Shares,
    block_products,
    board_picture,
    board_places,
    move_blocks,
    share_blocks,
)

Part = tuple[slice, slice]

SHARP_PX = 0.7
"""Blur, px, with which the model is drawn before further blur: it is band-limited at one sample per px (exp(-2 pi^2
0.7^2) is 6e-5), and within it the map is nearly affine."""

MAP_RINGS = 2
"""Squares beyond the corners for which the map is extrapolated, as far as blur brings them into view."""

PICTURE_SIGMAS, CHANGE_SIGMAS = 4.0, 2.75
"""Extent of the blur kernel, in s, for the model and for its derivatives, which need less accuracy."""

AROUND = 0.25
"""Upper bound of the extent of curved squares beyond the bounding box of their corners, over its size."""

LIGHT_SQUARES = 2.0
"""Distance, in squares, of the nodes between which light and blur are interpolated."""

MAX_EXTRAPOLATION_SQUARES = 1.5
"""Distance, in squares, up to which displacements of corners are extrapolated."""

END_SIGMA, PAPER_SIGMA, BLUR_SIGMA = 0.1, 1.0, 0.1
"""Prior standard deviations of the width of the outer squares (in squares), of the brightness beyond them (in half
contrasts), and of the relative variation of the blur."""

MAX_STEPS, SETTLED_SIGMAS = 6, 0.3
"""Largest number of Gauss-Newton steps, and the rms move of the corners, in sigmas, at which they end: the next step
would be about a fifth of it."""

HOLE_SIGMA_PX = 0.5
"""Prior standard deviation of missing corners, predicted by the others."""

OUTWARDS = np.array([-1.0, 1.0, -1.0, 1.0])
"""Outward directions, along columns and rows, at the first and the last end of the board."""

MIN_BLUR_OF_BOARD, MIN_SQUARE = 1.5, 9.0
"""Smallest s and smallest square, in pixels, after averaging or resampling pixels."""

MIN_BLUR_PX, SMALL_SQUARES = 1.2, 9.0
"""Smallest s, px, and largest squares, in s, of boards that are fitted as a whole. The errors of RENDERED boards in a
fisheye are then multiplied by 0.7 for squares of 8 s and by 0.55 for 5 s."""

MAX_HOLES = 0.1
"""Largest share of missing corners of a board that is fitted as a whole."""

MAX_TILE, OVERLAP = 14, 2
"""Largest tile of a board, in rows and columns, and overlap of tiles: the time grows with the cube of the corners."""

MAX_RESIDUAL = 1.25
"""Largest ratio of the residual to that of separate corners, which have four times as many unknowns. It is larger with
markers in the squares, or a hand in front of them."""


@dataclass(frozen=True, eq=False, slots=True)
class WholeBoard:
    """The fitted corners.

    Attributes
    ----------
    pixels : (R, C, 2)
    spread_px : (R, C) standard deviation per axis under independent noise of one grey level.
    residual : root mean square residual, grey levels, of averaged pixels.
    """

    pixels: FloatArray
    spread_px: FloatArray
    residual: float


@dataclass(frozen=True, eq=False, slots=True)
class _SheetParameters:
    """The unknowns: corners (R, C, 2), ends (2, 2), paper (4,), blur s, and light, contrast and relative increase of
    the blur (3, r, c) at nodes LIGHT_SQUARES apart."""

    pixels: FloatArray
    ends: FloatArray
    paper: FloatArray
    blur: float
    light: FloatArray


def placed_together(
    image: GreyImage, item: RefinedLattice, marked: Callable[[GreyImage, Lattice], bool] | None = None
) -> RefinedLattice:
    """Return `item` with jointly fitted corners if its squares are small relative to the blur and the model fits; else
    unchanged.

    Nor is a lattice changed that is `marked`, asked last: uniform squares are no model of squares with markers.
    """
    known = item.lattice.known
    few = min(known.shape) < MIN_ROWS or np.count_nonzero(~known) > MAX_HOLES * known.size
    blur = known_median(item.blur_px[known])
    if few or blur < MIN_BLUR_PX:
        return item
    shape = fit_cells(item.lattice.pixels, known)
    large = float(np.median(shape.gaps())) > SMALL_SQUARES * blur
    if large or (marked is not None and marked(image, item.lattice)):
        return item
    lattice, start = item.lattice, item.lattice.pixels
    geometry = Geometry(shape.sides, np.zeros((lattice.count, 2)), shape.gaps(), ends_of(known, known))
    outer = np.full((*known.shape, 4), np.nan)
    fitted = start[known], lattice.contrast[known], item.blur_px[known], lattice.signs()[known]
    outer[known] = outer_squares(image, geometry, *fitted).reshape(-1, 4)
    if not known.all():
        start = start.copy()
        start[~known] = predicted(start, ~known).pixels
    around = Surroundings.read(outer, start, blur, ~known)
    alone, noise = (float(np.sqrt(np.mean(part[known] ** 2))) for part in (item.residual, item.noise))
    pixels, sigma_px = lattice.pixels.copy(), item.sigma_px / item.scatter
    for rows, columns, kept in _tiles(known.shape):
        board = fit_whole_board(image, start[rows, columns], blur, around.of(rows, columns))
        if board is None or board.residual > MAX_RESIDUAL * alone:
            continue
        own = np.zeros(known.shape, np.bool_)
        own[kept] = known[kept]
        mine = own[rows, columns]
        pixels[own], sigma_px[own] = board.pixels[mine], board.spread_px[mine] * noise * item.correlated
    if np.array_equal(pixels, lattice.pixels, equal_nan=True):
        return item
    every = (slice(0, known.shape[0]), slice(0, known.shape[1]))
    scatter = float(scatter_factors(pixels, sigma_px, [every])[0])
    placed = replace(lattice, pixels=pixels)
    return replace(item, lattice=placed, sigma_px=sigma_px * scatter, scatter=scatter)


def fit_whole_board(image: GreyImage, pixels: FloatArray, blur: float, around: Surroundings) -> WholeBoard | None:
    """Return the joint fit of corners near `pixels` (R, C, 2) with an initial s of `blur` px; None if it fails."""
    if not np.isfinite(pixels).all():
        return None
    # Averaged pixels lose nothing in a blurred image.
    steps = [float(np.linalg.norm(np.diff(pixels, axis=axis), axis=2).min()) for axis in (0, 1)]
    scale = max(int(min(blur / MIN_BLUR_OF_BOARD, min(steps) / MIN_SQUARE)), 1)
    window = BoardWindow.around(image, pixels, scale, int(np.ceil(PICTURE_SIGMAS * blur)), around)
    if window is None:
        return None
    start = (pixels - window.first) / scale
    rows, columns = pixels.shape[:2]
    light = [int(np.ceil((count - 1) / LIGHT_SQUARES)) + 1 for count in (rows, columns)]
    state, there = _SheetParameters(start, window.ends, np.zeros(4), blur / scale, np.zeros((3, *light))), ~around.holes
    for turn in range(MAX_STEPS):
        step = _step(window, state, start=turn == 0)
        if step is None:
            return None
        state, moved, spread, residual = step
        if not np.isfinite(state.pixels).all() or np.abs(state.pixels - start)[there].max() > MAX_MOVE_PX:
            return None
        if np.mean((moved / (spread * residual))[there] ** 2) < SETTLED_SIGMAS**2:
            # The noise of averaged pixels decreases with their side, which cancels the scale of the sigmas.
            return WholeBoard(window.first + scale * state.pixels, spread, residual)
    return None


def _step(
    window: BoardWindow, state: _SheetParameters, *, start: bool
) -> tuple[_SheetParameters, FloatArray, FloatArray, float] | None:
    """Return the state after a Gauss-Newton step, the corners' moves and spreads, and the residual before it."""
    size = state.pixels.shape[0], state.pixels.shape[1]
    coefficients = spline_coefficients(extended(state.pixels, MAP_RINGS))
    places = board_places(coefficients, (0, 0, *window.grey.shape[::-1]), AROUND) - MAP_RINGS
    used = window.used(places, state.blur)
    count = int(np.count_nonzero(used))
    if count < state.pixels.size:
        return None
    rest_blur = float(np.sqrt(max(state.blur**2 - SHARP_PX**2, 0.25)))
    taps, short = _taps(rest_blur, PICTURE_SIGMAS), _taps(rest_blur, CHANGE_SIGMAS)
    planes = board_picture(places, size, state.ends, state.paper, SHARP_PX)
    pattern = _blurred(planes[0], taps)
    beyond = [_blurred(plane, taps) for plane in planes[3:]]
    if start:
        state = _with_light(window.grey, pattern, used, state, beyond[:4])
        planes = board_picture(places, size, state.ends, state.paper, SHARP_PX)
        pattern = _blurred(planes[0], taps)
    grid = state.light.shape[1], state.light.shape[2]
    near = Shares.at(places, grid, spacing=LIGHT_SQUARES, beyond=WINDOW_REACH, cubic=False, margin=0)
    base, contrast, wider = near.interpolated(state.light)
    # Derivative of the model by the relative blur, from the heat equation.
    spread = state.blur**2 * cv2.Laplacian(pattern, cv2.CV_32F)
    seen, on = pattern + wider * spread, used.astype(np.float32)
    rest, weight = on * (window.grey - base - contrast * seen), on * contrast
    corners = Shares.at(places, size, spacing=1.0, beyond=MAX_EXTRAPOLATION_SQUARES, cubic=True, margin=len(short) // 2)
    whole = np.stack([weight * plane for plane in (*beyond, spread)])
    everywhere = np.array([[0, 0, rest.shape[1] - 1, rest.shape[0] - 1]])
    blocks = (
        move_blocks(corners, planes[1:3], weight, short),
        share_blocks(near, np.stack([on, on * seen, weight * spread])),
        Blocks(everywhere, np.zeros(1, np.int64), len(whole), whole.ravel()),
    )
    return _solved(window, state, *block_products(blocks, rest), rest, count)


def _solved(
    window: BoardWindow, state: _SheetParameters, products: FloatArray, right: FloatArray, rest: Picture, count: int
) -> tuple[_SheetParameters, FloatArray, FloatArray, float] | None:
    """Return the results of `_step` from the normal equations without prior."""
    shape, unknowns, corners = state.pixels.shape, len(right), state.pixels.size
    variance = float((rest.astype(np.float64) ** 2).sum()) / max(count - unknowns, 1)
    variance = max(variance, ROUNDING_VARIANCE / window.scale**2)
    # The unknowns after the corners: light, contrast and relative blur of each node; paper; ends; blur.
    light, paper, ends = slice(corners, -9), slice(-9, -5), slice(-5, -1)
    known, off = np.full(unknowns, FREE), np.zeros(unknowns)
    known[corners + 2 : -9 : 3], off[corners + 2 : -9 : 3] = BLUR_SIGMA**-2, state.light[2].ravel()
    known[:corners][np.repeat(window.surroundings.holes.ravel(), 2)] = HOLE_SIGMA_PX**-2
    known[paper], off[paper] = PAPER_SIGMA**-2, state.paper
    known[ends], off[ends] = END_SIGMA**-2, OUTWARDS * (state.ends - window.ends).ravel()
    products[np.diag_indices(unknowns)] += variance * known
    try:
        inverse = np.linalg.inv(products)
    except np.linalg.LinAlgError:
        return None
    step = inverse @ (right - variance * known * off)
    spread = np.sqrt(np.maximum(np.diag(inverse)[:corners].reshape(shape).mean(axis=2), 0.0))
    moves = step[:corners].reshape(shape).clip(-MAX_MOVE_PX, MAX_MOVE_PX)
    blur = state.blur * (1.0 + float(np.clip(step[-1], -MAX_BLUR_CHANGE, MAX_BLUR_CHANGE)))
    after = _SheetParameters(
        state.pixels + moves,
        state.ends + (OUTWARDS * step[ends].clip(-END_SIGMA, END_SIGMA)).reshape(2, 2),
        (state.paper + step[paper]).clip(-MAX_PAPER, MAX_PAPER),
        float(np.clip(blur, *BLUR_RANGE)),
        state.light + step[light].reshape(-1, 3).T.reshape(state.light.shape),
    )
    return after, np.hypot(moves[..., 0], moves[..., 1]), spread, float(np.sqrt(variance))


def _with_light(
    grey: Picture, pattern: Picture, used: BoolArray, state: _SheetParameters, beyond: Sequence[Picture]
) -> _SheetParameters:
    """Return the state with the least squares light, contrast and paper, assumed to be uniform."""
    columns = np.stack([np.ones(np.count_nonzero(used)), *(part[used] for part in (pattern, *beyond))], axis=1)
    normal = columns.T @ columns + np.diag([0.0, FREE, 1.0, 1.0, 1.0, 1.0])
    base, contrast, *paper = np.linalg.solve(normal, columns.T @ grey[used])
    light = np.zeros(state.light.shape)
    light[0], light[1] = base, contrast
    levels = np.array(paper) / (contrast if abs(contrast) > FREE else FREE)
    return replace(state, paper=levels.clip(-MAX_PAPER, MAX_PAPER), light=light)


def _tiles(shape: tuple[int, int]) -> list[tuple[slice, slice, Part]]:
    """Return the tiles of a lattice: rows and columns of each, and the part that belongs to no other tile."""
    rows, columns = (_spans(count) for count in shape)
    return [(down, along, (own_down, own_along)) for down, own_down in rows for along, own_along in columns]


def _spans(count: int) -> list[tuple[slice, slice]]:
    parts = -(-count // MAX_TILE)
    bounds = np.linspace(0, count, parts + 1).round().astype(int).tolist()
    return [
        (slice(max(first - OVERLAP, 0), min(last + OVERLAP, count)), slice(first, last))
        for first, last in pairwise(bounds)
    ]


def _blurred(plane: Picture, taps: Picture) -> Picture:
    return np.asarray(cv2.sepFilter2D(plane, cv2.CV_32F, taps, taps))


def _taps(blur: float, sigmas: float) -> Picture:
    """Return a Gaussian of standard deviation `blur`, cut at `sigmas` of it, (2 K + 1,)."""
    radius = int(np.ceil(sigmas * blur))
    taps = np.exp(-0.5 * (np.arange(-radius, radius + 1) / blur) ** 2)
    return np.asarray(taps / taps.sum(), np.float32)


def spline_coefficients(nodes: FloatArray) -> FloatArray:
    """Return the coefficients (R + 2, C + 2, 2) of the cubic B-spline through `nodes` (R, C, 2), of five rows or more,
    with "not a knot" end conditions."""
    down, along = (_collocation(count) for count in nodes.shape[:2])
    return np.ascontiguousarray(np.moveaxis(down @ np.moveaxis(nodes, 2, 0) @ along.T, 0, 2))


@functools.cache
def _collocation(count: int) -> FloatArray:
    """Return the matrix (N + 2, N) from values at N nodes to coefficients."""
    matrix = np.zeros((count + 2, count + 2))
    for k in range(count):
        matrix[k + 1, k : k + 3] = 1.0 / 6.0, 4.0 / 6.0, 1.0 / 6.0
    matrix[0, :5] = matrix[-1, -5:] = 1.0, -4.0, 6.0, -4.0, 1.0
    return np.asarray(np.linalg.inv(matrix)[:, 1:-1])
