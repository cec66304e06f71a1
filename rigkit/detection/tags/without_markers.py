"""Removal of the markers from an image of a ChArUco board, by adding the light that their ink absorbs.

Blur brings the ink of markers into the windows of adjacent corners, and shifts these by more than their sigmas. The
board determines where the ink is, and the surrounding squares how much light it absorbs: with this light added, the
image is that of a chessboard.
"""

from __future__ import annotations

import functools
from typing import NamedTuple

import cv2
import numpy as np

from rigkit.core.arrays import BoolArray, FloatArray
from rigkit.core.boards import Board
from rigkit.core.patterns.charuco import Charuco
from rigkit.detection.lattice.lattice import MIN_ROWS
from rigkit.detection.lattice.local_fit import fit_cells, predicted
from rigkit.detection.saddles.response import GreyImage
from rigkit.detection.subpixel.board_window import extended
from rigkit.detection.subpixel.edge_model import WINDOW_REACH
from rigkit.detection.subpixel.refined import RefinedLattice
from rigkit.detection.subpixel.uncertain_corners import uncertain
from rigkit.detection.subpixel.whole_board import (
    AROUND,
    MAP_RINGS,
    PICTURE_SIGMAS,
    SHARP_PX,
    spline_coefficients,
)
from rigkit.kernels.boards import Picture, board_picture, board_places, sheet_places

DRAWN_PX = 3.0
"""Number of samples per px of the image with which ink is drawn, for squares of median size."""

MAX_SQUARE = 64
"""Largest number of samples along a square; sharp images with larger squares need no removal."""

AROUND_CORNER = np.ones((3, 3), np.uint8)
"""Neighbourhood of known corners in which predictions are accurate enough for the removal of markers."""

SHADE_SQUARES = 1.0
"""Standard deviation, in squares, of the Gaussian weight of the pixels that determine black and white."""

STEPS_OF_SHADE = 4.0
"""Number of points per standard deviation at which black and white are evaluated."""

MIN_MARKER_CONTRAST = 1e-3
"""Smallest weighted variance of the board's picture (1 and -1) for which black and white can be separated."""


class WithoutMarkers(NamedTuple):
    """A picture without markers, and the light that ink absorbs (H, W) where it is known."""

    picture: GreyImage
    light: Picture


def without_markers(
    image: GreyImage, refined: RefinedLattice, board: Board, blur: float, light: Picture | None = None
) -> WithoutMarkers | None:
    """Return `image` as if the squares of a ChArUco `board` were empty; None if too little of it is visible.

    Parameters
    ----------
    image : grey.
    refined : the corners, on the grid of the board; missing ones are predicted from the others.
    blur : s of the edges, px.
    light : light that ink absorbs, known from almost the same corners; by default it is estimated from the image.
    """
    # Partly covered corners are predicted from the others.
    seen = _seen(np.where(uncertain(refined.sigma_px)[..., None], np.nan, refined.lattice.pixels))
    if seen is None:
        return None
    pixels, known, (row, column) = seen
    around = extended(pixels, MAP_RINGS)
    if not np.isfinite(around).all():
        return None
    left, top, width, height = box = _box(image, around, PICTURE_SIGMAS * blur)
    places = board_places(spline_coefficients(around), box, AROUND) - MAP_RINGS
    square_px = float(np.median(fit_cells(pixels, known, degree=1).cell_px()))
    rest_blur = float(np.sqrt(max(blur**2 - SHARP_PX**2, 0.25)))
    first, ends = np.array([column, row]), np.array([[-1.0, board.columns], [-1.0, board.rows]])
    assert isinstance(board.pattern, Charuco)
    white = -1.0 if board.pattern.first_black(board.rows) == ((row + column) % 2 == 0) else 1.0
    each = int(np.clip(np.ceil(DRAWN_PX * square_px), 8, MAX_SQUARE))
    around_known = cv2.dilate(known.astype(np.uint8), AROUND_CORNER) > 0
    corners, reach = np.stack([known, around_known]), np.array([WINDOW_REACH, 1.0])
    on_sheet, (used, on_board) = sheet_places(places, -1.0 - first, each, corners, reach)
    marks = _blurred(_ink(board, on_sheet, each, square_px), rest_blur)
    out, here = image.astype(np.float32), (slice(top, top + height), slice(left, left + width))
    if light is None:
        squares = board_picture(places, known.shape, ends - first[:, None], np.zeros(4), SHARP_PX, planes=1)[0]
        squares = white * _blurred(squares, rest_blur) - 2.0 * marks
        light = np.zeros(out.shape, np.float32)
        light[here] = 2.0 * _contrast(out[here], squares, used, SHADE_SQUARES * square_px)
    out[here] += marks * light[here] * on_board
    return WithoutMarkers(out, light)


def _seen(pixels: FloatArray) -> tuple[FloatArray, BoolArray, tuple[int, int]] | None:
    """Return the known part of a board's corners (R, C, 2), with a margin of one corner and missing ones predicted;
    which are known; and row and column of the first one. None if predictions fail."""
    known = np.isfinite(pixels[..., 0])
    spans = []
    for axis in (1, 0):
        lines = np.flatnonzero(known.any(axis=axis))
        if len(lines) < MIN_ROWS:
            return None
        spans.append(slice(max(int(lines[0]) - 1, 0), int(lines[-1]) + 2))
    part, known = pixels[spans[0], spans[1]].copy(), known[spans[0], spans[1]]
    while np.isnan(part[..., 0]).any():
        # Ring by ring: far from all known corners polynomials diverge.
        missing = np.isnan(part[..., 0])
        beside = missing & (cv2.dilate((~missing).astype(np.uint8), AROUND_CORNER) > 0)
        part[beside] = predicted(part, beside).pixels
        if np.isnan(part[beside]).any():
            return None
    areas = fit_cells(part, np.ones_like(known), degree=1).areas()
    return (part, known, (spans[0].start, spans[1].start)) if (areas > 0.0).all() else None


def _box(image: GreyImage, lattice: FloatArray, margin: float) -> tuple[int, int, int, int]:
    """Return the first column and row, width and height of the part of an image with a `lattice` (R, C, 2)."""
    around = lattice[1:-1, 1:-1].reshape(-1, 2)
    last = np.array(image.shape[::-1]) - 1.0
    low = np.clip(np.floor(around.min(axis=0) - margin), 0.0, last)
    high = np.clip(np.ceil(around.max(axis=0) + margin), 0.0, last)
    (left, top), (right, bottom) = low.astype(int).tolist(), high.astype(int).tolist()
    return left, top, right - left + 1, bottom - top + 1


def _ink(board: Board, on_sheet: Picture, each: int, square_px: float) -> Picture:
    """Return the ink of markers (H, W), 0 to 1, blurred by SHARP_PX; `on_sheet` (2, H, W) are the places of the pixels
    on `_sheet`."""
    columns, rows = on_sheet
    smooth = _blurred(_sheet(board, each), SHARP_PX * each / square_px)
    return np.asarray(cv2.remap(smooth, columns, rows, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT))


@functools.lru_cache(maxsize=8)
def _sheet(board: Board, each: int) -> Picture:
    """Return the ink of a board's markers, 0 to 1, with `each` x `each` samples per square, from the square before the
    first corner."""
    columns, rows = board.size
    sheet = np.zeros(((rows + 1) * each, (columns + 1) * each), np.float32)
    scale = np.tile(each / np.array(board.squares_mm), 2)
    for x, y, wide, high in board.ink().rectangles * scale:
        # Sides of modules are between samples.
        down, across = _covered(sheet.shape[0], y + each, high), _covered(sheet.shape[1], x + each, wide)
        sheet[down[0], across[0]] += np.outer(down[1], across[1]).astype(np.float32)
    return sheet


def _covered(length: int, start: float, extent: float) -> tuple[slice, FloatArray]:
    """Return the samples, in a row of `length`, from `start` over `extent`, and the covered part of each."""
    first, last = max(int(np.floor(start)), 0), min(int(np.ceil(start + extent)), length)
    samples = np.arange(first, last)
    part = np.minimum(samples + 1.0, start + extent) - np.maximum(samples, start)
    return slice(first, last), np.clip(part, 0.0, 1.0)


def _contrast(image: Picture, picture: Picture, used: BoolArray, reach_px: float) -> Picture:
    """Return the regression slope (H, W) of `image` on `picture` around each pixel, from the pixels `used`."""
    # The slope changes so slowly that it is computed from means of many pixels.
    step = max(int(reach_px / STEPS_OF_SHADE), 1)
    size = (-(-image.shape[1] // step), -(-image.shape[0] // step))
    weight = used.astype(np.float32)
    planes = (weight, weight * image, weight * picture, weight * picture**2, weight * picture * image)
    means = (cv2.resize(plane, size, interpolation=cv2.INTER_AREA) for plane in planes)
    total, seen, drawn, squared, both = (_blurred(np.asarray(plane), reach_px / step) for plane in means)
    total = np.maximum(total, 1e-6)
    variance = squared / total - (drawn / total) ** 2
    slope = (both / total - seen * drawn / total**2) / np.maximum(variance, MIN_MARKER_CONTRAST)
    slope = np.where(variance > MIN_MARKER_CONTRAST, slope, 0.0).astype(np.float32)
    return np.asarray(cv2.resize(slope, image.shape[::-1], interpolation=cv2.INTER_LINEAR), np.float32)


def _blurred(plane: Picture, sigma_px: float) -> Picture:
    return np.asarray(cv2.GaussianBlur(plane, (0, 0), sigma_px, borderType=cv2.BORDER_CONSTANT))
