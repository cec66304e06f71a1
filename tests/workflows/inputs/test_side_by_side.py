"""Images that hold the pictures of two cameras."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest

from rigkit.core.boards import Board
from rigkit.core.detections import BoardDetection
from rigkit.io.corners.corner_cache import FoundCorners
from rigkit.workflows.inputs.side_by_side import side_by_side_pictures

BOARD = Board("b", 4, 3, 30.0, 30.0)


def _seen(*places: tuple[float, float], square: float = 20.0) -> FoundCorners:
    """Corners of boards of 3 x 2 squares, px, whose first corners are at `places`, in an image of 800 x 600 px."""
    grid = np.argwhere(np.ones((3, 4)))[:, ::-1]
    found = [
        BoardDetection("b", 4, 3, grid, np.asarray(square * grid + place, np.float64), np.full(12, 0.1))
        for place in places
    ]
    return FoundCorners((800, 600), tuple(found))


LEFT_RIGHT = [_seen((100 + 9 * k, 200), (480 + 9 * k, 200), square=20.0 + k) for k in range(4)]


@pytest.mark.parametrize(
    ("images", "words"),
    [
        (LEFT_RIGHT, "in the left and the right half: 4 of 4"),
        (
            [_seen((300, 40 + 9 * k), (300, 400), square=20.0 + k) for k in range(3)] + [_seen((300, 50))],
            "the bottom half: 3 of 4",
        ),
        (LEFT_RIGHT[:2], None),
        ([*LEFT_RIGHT, _seen((370, 200))], None),
        (LEFT_RIGHT + [_seen((100, 200))] * 5, None),
        # One camera, nearer and nearer to two boards, that keeps what is between them in its middle.
        ([_seen((390 - 4 * s, 200), (410 + s, 200), square=s) for s in (20.0, 30.0, 40.0)], None),
        ([_seen()], None),
    ],
    ids=["left-right", "top-bottom", "few", "across", "one half only", "two boards", "none"],
)
def test_both_halves_show_the_only_board(images: Sequence[FoundCorners], words: str | None) -> None:
    found = {f"{k}.png": item for k, item in enumerate(images)}
    told = side_by_side_pictures(found, [BOARD])
    assert (words in told) if words is not None and told is not None else told is words
    # Of two boards of one kind one may be in each half.
    assert side_by_side_pictures(found, [BOARD, Board("c", 4, 3, 30.0, 30.0)]) is None
