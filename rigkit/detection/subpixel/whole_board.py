"""Boards whose squares are small against the blur: the picture of the whole board is fitted at once.

Where edges spread over most of a square, a corner's window holds little but other corners' edges. What these are there,
only the whole board says: its picture is that of even squares, bent as a smooth map through all corners has it, under a
light that changes slowly, blurred; all corners are sought together. So many fewer unknowns are left for every corner
that its standard deviation falls below that of single corners' windows.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import cv2
import numpy as np

from rigkit.core.arrays import BoolArray, FloatArray, known_median
from rigkit.detection.lattice.local_fit import fit_cells, predicted
from rigkit.detection.saddles.response import GreyImage
from rigkit.detection.subpixel.board_window import BoardWindow, Surroundings, extended
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
"""The picture is drawn with this blur, and blurred: at one sample a px nothing of it is lost (exp(-2 pi^2 0.7^2) is
6e-5), and within so little of it the map is as good as straight."""

MAP_RINGS = 2
"""The map goes on so many squares beyond the corners: blur brings no more of what is there into their windows."""

PICTURE_SIGMAS, CHANGE_SIGMAS = 4.0, 2.75
"""Pictures are blurred from so far away, s, and their changes, which only lead to the corners."""

AROUND = 0.25
"""Bent sides of squares leave the box of their corners by less than this part of it."""

LIGHT_SQUARES = 2.0
"""Light and blur are interpolated between values so far apart, squares."""

MAX_EXTRAPOLATION_SQUARES = 1.5
"""What is told by corners goes on so far beyond them, squares."""

END_SIGMA, PAPER_SIGMA, BLUR_SIGMA = 0.1, 1.0, 0.1
"""How well it is known beforehand how large the outer squares are, in squares, how bright it is beyond them, in half
contrasts, and that blur is everywhere the same, relative."""

MAX_STEPS, SETTLED_SIGMAS = 6, 0.3
"""Gauss-Newton steps at most; one that moves corners by less than this, in their sigmas, is the last: the next one
would by a fifth of it."""

HOLE_SIGMA_PX = 0.5
"""How well corners that nobody saw are foretold by the others."""

FREE = 1e-6
"""What is known of everything else."""

OUTWARDS = np.array([-1.0, 1.0, -1.0, 1.0])
"""Which way, along columns and rows, the board ends first and last."""

MIN_ROWS = 3
"""Steps between corners have neighbours."""

MIN_BLUR_OF_BOARD, MIN_SQUARE = 1.5, 9.0
"""Pixels are made larger while blur is so many of them, and the smallest square."""

MIN_BLUR_PX, SMALL_SQUARES = 1.2, 9.0
"""Boards whose squares are smaller than so many s are fitted as a whole, under a blur that is more than that with which
the picture is drawn. Rendered ones in a fisheye are then placed better by 0.7 at 8 s and 0.55 at 5 s."""

MAX_HOLES = 0.1
"""Boards that lack more of their corners are left as they are: little is known of what is there."""

MAX_TILE, OVERLAP = 14, 2
"""Larger boards are fitted in tiles of so many rows and columns, which share some: the time grows with the cube."""

MAX_RESIDUAL = 1.25
"""The picture of the board may leave so much more than the corners by themselves do, which have four times as many
unknowns. It leaves more where there are marks in the squares, or a hand on them."""


@dataclass(frozen=True, eq=False, slots=True)
class WholeBoard:
    """The fitted corners.

    Attributes
    ----------
    pixels : (R, C, 2)
    spread_px : (R, C) standard deviation per axis under independent noise of one grey level.
    residual : root mean square of what is left, grey levels, of pixels as large as they were made.
    """

    pixels: FloatArray
    spread_px: FloatArray
    residual: float


@dataclass(frozen=True, eq=False, slots=True)
class _SheetParameters:
    """What is sought: corners (R, C, 2), ends (2, 2), paper (4,), blur s, and light, contrast and by how much the blur
    is wider, relative, (3, r, c) at nodes LIGHT_SQUARES apart."""

    pixels: FloatArray
    ends: FloatArray
    paper: FloatArray
    blur: float
    light: FloatArray


def placed_together(image: GreyImage, item: RefinedLattice) -> RefinedLattice:
    """Return `item` with its corners placed together where its squares are small against the blur, and the picture is
    as that of a board; else as it is."""
    lattice, known = item.lattice, item.lattice.known
    start, blur = lattice.pixels, known_median(item.blur_px[known])
    few = min(known.shape) < MIN_ROWS or np.count_nonzero(~known) > MAX_HOLES * known.size
    if few or blur < MIN_BLUR_PX:
        return item
    shape = fit_cells(start, known)
    if float(np.median(shape.gaps())) > SMALL_SQUARES * blur:
        return item
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
    """Return the corners near `pixels` (R, C, 2) of a board, under a blur of about `blur` px.

    None where they are not found near them.
    """
    if not np.isfinite(pixels).all():
        return None
    # Blur leaves nothing that larger pixels would not show.
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
            # Larger pixels have less noise, by their side: sigmas are as those in pixels of the image.
            return WholeBoard(window.first + scale * state.pixels, spread, residual)
    return None


def _step(
    window: BoardWindow, state: _SheetParameters, *, start: bool
) -> tuple[_SheetParameters, FloatArray, FloatArray, float] | None:
    """Return the state after a Gauss-Newton step, how far each corner moved, its spread, and the residual before it."""
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
    # How the picture grows with the blur, relative: heat spreads so.
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
    """Return what `_step` does, from the normal equations without what is known beforehand."""
    shape, unknowns, corners = state.pixels.shape, len(right), state.pixels.size
    variance = float((rest.astype(np.float64) ** 2).sum()) / max(count - unknowns, 1)
    variance = max(variance, ROUNDING_VARIANCE / window.scale**2)
    # After the corners: light, contrast and relative blur of each node; paper; ends; blur.
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
    """Return the state with the light, contrast and paper that fit best if they are everywhere the same."""
    columns = np.stack([np.ones(np.count_nonzero(used)), *(part[used] for part in (pattern, *beyond))], axis=1)
    normal = columns.T @ columns + np.diag([0.0, FREE, 1.0, 1.0, 1.0, 1.0])
    base, contrast, *paper = np.linalg.solve(normal, columns.T @ grey[used])
    light = np.zeros(state.light.shape)
    light[0], light[1] = base, contrast
    levels = np.array(paper) / (contrast if abs(contrast) > FREE else FREE)
    return replace(state, paper=levels.clip(-MAX_PAPER, MAX_PAPER), light=light)


def _tiles(shape: tuple[int, int]) -> list[tuple[slice, slice, Part]]:
    """Return tiles of a lattice: their rows and columns, and which of these no other tile has."""
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
    """Return the coefficients (R + 2, C + 2, 2) of the cubic B-spline through `nodes` (R, C, 2), of five rows or more.

    At the ends the third derivative goes on: "not a knot".
    """
    down, along = (_collocation(count) for count in nodes.shape[:2])
    return np.ascontiguousarray(np.moveaxis(down @ np.moveaxis(nodes, 2, 0) @ along.T, 0, 2))


@functools.cache
def _collocation(count: int) -> FloatArray:
    """Return the matrix (N + 2, N) that turns values at N nodes into coefficients."""
    matrix = np.zeros((count + 2, count + 2))
    for k in range(count):
        matrix[k + 1, k : k + 3] = 1.0 / 6.0, 4.0 / 6.0, 1.0 / 6.0
    matrix[0, :5] = matrix[-1, -5:] = 1.0, -4.0, 6.0, -4.0, 1.0
    return np.asarray(np.linalg.inv(matrix)[:, 1:-1])
