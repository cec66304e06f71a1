"""Boards whose squares are a few pixels of a large image are found in its own pixels."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from rigkit import detect_boards
from rigkit.core.boards import Board

BOARD = Board("b", 9, 6, 30.0, 30.0)
SIZE, SQUARE_PX, SHARP = (2240, 1400), 6.5, 8


@pytest.mark.parametrize("declared", [True, False])
def test_squares_of_six_pixels_in_a_large_image(declared: bool, rng: np.random.Generator) -> None:
    squares = np.indices((BOARD.rows + 3, BOARD.columns + 3)).sum(axis=0) % 2 == 0
    squares[[0, -1]], squares[:, [0, -1]] = False, False
    print_ = np.kron(np.where(squares, 40.0, 210.0), np.ones((SHARP, SHARP))).astype(np.float32)
    scale, turn = SQUARE_PX / SHARP, 0.3
    across = scale * np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    shift = np.array([1500.3, 900.7])
    # Four times as fine, then averaged over the pixels.
    window, first = 200, np.array([1400.0, 880.0])
    fine = np.column_stack([4.0 * across, 4.0 * (shift - first) + 1.5])
    seen = cv2.warpAffine(print_, fine, (4 * window, 4 * window), flags=cv2.INTER_LINEAR, borderValue=210.0)
    image = np.full(SIZE[::-1], 210.0)
    left, top = first.astype(int)
    image[top : top + window, left : left + window] = cv2.resize(seen, (window, window), interpolation=cv2.INTER_AREA)
    image = np.clip(np.rint(image + rng.normal(0.0, 1.5, image.shape)), 0, 255).astype(np.uint8)
    corner = np.stack(np.meshgrid(np.arange(BOARD.columns), np.arange(BOARD.rows)), axis=-1).reshape(-1, 2)
    truth = (SHARP * (corner + 2.0) - 0.5) @ across.T + shift
    (found,) = detect_boards(image, [BOARD] if declared else None)
    assert found.complete and found.board_id == ("b" if declared else None)
    apart = found.pixels[:, None] - truth
    off = apart[np.arange(len(truth)), np.linalg.norm(apart, axis=2).argmin(axis=1)]
    assert np.sqrt((off**2 / found.sigma_px[:, None] ** 2).mean()) < 1.6
    assert detect_boards(image, [BOARD], quick=True) == ()
