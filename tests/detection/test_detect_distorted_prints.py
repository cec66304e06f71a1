"""Boards changed by the printer or overexposure: squares slightly too large, too small, or rounded."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from rigkit.core.arrays import Pixels
from rigkit.core.boards import Board
from rigkit.detection.detect import detect_boards

COLUMNS, ROWS, SIDE_PX = 8, 6, 36.0
FINE = 4
"""Sub-samples a pixel along each axis."""


def print_of(grow: float, rounding: float, rng: np.random.Generator, scale: int = 1) -> tuple[np.ndarray, Pixels]:
    """Return a picture, slightly turned, of a board whose black squares are larger by `grow` of a side on each side and
    rounded, and its true corners."""
    turn = np.radians(8.0)
    parts, width, height = FINE // scale, 440 * scale, 360 * scale
    axes = scale * SIDE_PX * np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    first = scale * np.array([130.0, 90.0])
    fine = [(np.arange(size * parts) + 0.5) / parts - 0.5 for size in (width, height)]
    x, y = np.moveaxis((np.stack(np.meshgrid(*fine), axis=-1) - first) @ np.linalg.inv(axes).T, -1, 0)
    black = np.zeros(x.shape, bool)
    cell = np.floor(np.stack([x, y]))
    part = np.stack([x, y]) - cell
    # A square reaches into its neighbours, no farther than it has grown: there these are asked too.
    grown = max(grow, 0.0) + 1e-9
    may = {-1: part <= grown, 0: np.ones(part.shape, bool), 1: part >= 1.0 - grown}
    odd = cell.sum(axis=0) % 2 == 1
    for across, down in np.ndindex(3, 3):
        asked = may[across - 1][0] & may[down - 1][1] & (odd == ((across + down) % 2 == 1))
        step = np.array([[across - 1], [down - 1]])
        column, row = cell[:, asked] + step
        off = np.abs(part[:, asked] - step - 0.5) - (0.5 + grow - rounding)
        inside = np.hypot(*np.maximum(off, 0.0)) + np.minimum(off.max(axis=0), 0.0) < rounding
        board = (column >= -1) & (column < COLUMNS) & (row >= -1) & (row < ROWS)
        black[asked] |= inside & board
    levels = np.where(black, 20.0, 200.0).reshape(height, parts, width, parts).mean(axis=(1, 3))
    image = cv2.GaussianBlur(levels, (0, 0), 0.6) + 2.0 * rng.standard_normal(levels.shape)
    grid = np.stack(np.meshgrid(np.arange(COLUMNS), np.arange(ROWS)), axis=-1).reshape(-1, 2)
    return np.clip(np.rint(image), 0, 255).astype(np.uint8), grid @ axes.T + first


@pytest.mark.parametrize("grow", [-0.03, -0.02, 0.0, 0.02, 0.03])
@pytest.mark.parametrize("rounding", [1e-6, 0.1])
def test_ink_that_spreads_loses_no_board_and_moves_no_corner(
    grow: float, rounding: float, rng: np.random.Generator
) -> None:
    image, truth = print_of(grow, rounding, rng)
    (found,) = detect_boards(image)
    assert (found.columns, found.rows, found.complete) == (COLUMNS, ROWS, True)
    errors = found.pixels - truth
    assert np.abs(errors).max() < 0.12
    assert np.sqrt((errors**2).sum(axis=1).mean()) < 0.04
    assert np.sqrt((errors**2 / found.sigma_px[:, None] ** 2).mean()) < 1.4


@pytest.mark.parametrize("grow", [-0.03, 0.03])
def test_squares_that_overlap_by_pixels_are_corners_at_a_coarser_level(grow: float, rng: np.random.Generator) -> None:
    image, truth = print_of(grow, 1e-6, rng, scale=2)
    (found,) = detect_boards(image)
    assert found.complete and len(found.grid) == COLUMNS * ROWS
    assert np.abs(found.pixels - truth).max() < 0.12


@pytest.mark.parametrize("grow", [-0.06, 0.05])
def test_squares_that_run_over_by_pixels_are_found_at_coarser_levels(grow: float, rng: np.random.Generator) -> None:
    """3.6 and 4.3 px: on the finest level, the corners are bars of one brightness. Their sigmas say that they are less
    sure."""
    image, truth = print_of(grow, 1e-6, rng, scale=2)
    (found,) = detect_boards(image, [Board("b", COLUMNS, ROWS, 30.0, 30.0)])
    assert found.complete and found.board_id == "b"
    errors = found.pixels - truth
    assert np.sqrt((errors**2 / found.sigma_px[:, None] ** 2).mean()) < 1.4
