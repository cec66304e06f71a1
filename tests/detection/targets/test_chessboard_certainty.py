"""Where the corners of chessboards are completed: in the image as it is, or in a resampled part of it."""

from __future__ import annotations

import numpy as np
import pytest

from rigkit.core.detections import BoardDetection
from rigkit.detection.subpixel.refined import RefinedLattice
from rigkit.detection.targets import chessboard
from rigkit.detection.targets.base import Search
from rigkit.detection.targets.chessboard import ChessboardFinder, _with_more_certain

GRID = np.stack(np.meshgrid(np.arange(6), np.arange(4)), axis=-1).reshape(-1, 2)
SAME_PX = 30.0


def seen(sigma_px: float, *, at: float = 300.0, certain: int = 0) -> BoardDetection:
    """Return a board of 6 x 4 corners 300 px apart; `certain` of them with sigmas of 0.1 px."""
    sigmas = np.full(len(GRID), sigma_px)
    sigmas[:certain] = 0.1
    return BoardDetection(None, 6, 4, GRID, (at + 300.0 * GRID).astype(np.float64), sigmas)


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


def test_corners_are_added_in_the_image_before_it_is_stretched(monkeypatch: pytest.MonkeyPatch) -> None:
    # In an image of 16 bits (REAL, thermal) the missed corner is darker than those found.
    class Stretching(Search):
        @property
        def lattices(self) -> list[RefinedLattice]:
            self.grey = np.zeros((20, 20), np.float32)
            return []

    images: list[np.ndarray] = []

    def in_image(grey: np.ndarray, *_: object, **__: object) -> list[BoardDetection]:
        images.append(grey)
        return []

    monkeypatch.setattr(chessboard, "_in_image", in_image)
    given = np.ones((20, 20), np.float32)
    ChessboardFinder().find(Stretching(given, (), 9, None), ())
    assert images[0] is given
