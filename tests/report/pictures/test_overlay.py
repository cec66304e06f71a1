"""The overlay draws each board over a copy of the image."""

from __future__ import annotations

import numpy as np

from rigkit.core.boards import Board
from rigkit.core.detections import BoardDetection
from rigkit.report.pictures.overlay import OVERLAY_COLOURS, draw_boards

INK_LEVELS = 60
"""From the colour of a label: OpenCV 4 draws hairlines whose ink is nowhere full."""


def test_rows_are_drawn_through_the_corners() -> None:
    board = Board("a", 4, 3, 30.0, 30.0)
    pixels = 30.0 * board.grid().astype(float) + 40.0
    found = BoardDetection("a", 4, 3, board.grid(), pixels, np.full(12, 0.01))
    for image in (np.full((150, 200), 128, np.uint8), np.full((150, 200, 3), 30000, np.uint16)):
        before = image.copy()
        picture = draw_boards(image, [found])
        assert np.array_equal(image, before)
        assert picture.shape == (150, 200, 3)
        middles = (0.5 * (pixels[:-1] + pixels[1:]))[[0, 1, 4, 5, 8, 9]].astype(int)
        assert all((picture[v, u] == OVERLAY_COLOURS[0]).all() for u, v in middles)
        assert (picture[145, 5] == picture[145, 195]).all()


def test_the_label_stays_inside_the_image() -> None:
    """As much of it is drawn at the right edge as at the left: ink of the board's colour, on white."""
    board = Board("a", 4, 3, 30.0, 30.0)
    ink = []
    for column in (40.0, 260.0):
        pixels = 10.0 * board.grid() + [column, 100.0]
        found = BoardDetection("a", 4, 3, board.grid(), pixels, np.full(12, 0.01))
        label = draw_boards(np.full((150, 300), 60, np.uint8), [found])[70:93]
        ink.append(int((np.abs(label - np.asarray(OVERLAY_COLOURS[0], float)).max(axis=-1) < INK_LEVELS).sum()))
    assert ink[0] > 20
    assert ink[1] == ink[0]
