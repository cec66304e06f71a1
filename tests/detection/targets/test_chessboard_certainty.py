"""Boards found in the image with a camera's help, and in a resampled part of it: the more certain corners count."""

from __future__ import annotations

import numpy as np
import pytest

from rigkit.core.detections import BoardDetection
from rigkit.detection.targets.chessboard import _with_more_certain

GRID = np.stack(np.meshgrid(np.arange(6), np.arange(4)), axis=-1).reshape(-1, 2)
SAME_PX = 30.0


def seen(sigma_px: float, *, at: float = 300.0, certain: int = 0) -> BoardDetection:
    """Return a board of 6 x 4 corners 300 px apart; `certain` of them with sigmas of 0.1 px."""
    sigmas = np.full(len(GRID), sigma_px)
    sigmas[:certain] = 0.1
    return BoardDetection(None, 6, 4, GRID, at + 300.0 * GRID, sigmas)


@pytest.mark.parametrize("certain", [0, 2])
def test_more_certain_corners_replace_the_same_ones(certain: int) -> None:
    # As in photographs of 48 megapixels: 4 px in the image, a few corners apart, 0.6 px in the resampled part.
    vague, sure, other = seen(4.0, certain=certain), seen(0.6, at=306.0), seen(4.0, at=4000.0)
    assert _with_more_certain([vague, other], [sure], SAME_PX) == [other, sure]
    assert _with_more_certain([sure, other], [vague], SAME_PX) == [sure, other]


def test_a_little_more_certain_corners_replace_none() -> None:
    # Of the same pixels the camera knows the lines.
    by_camera, part = seen(0.10), seen(0.07, at=301.0)
    assert _with_more_certain([by_camera], [part], SAME_PX) == [by_camera]
