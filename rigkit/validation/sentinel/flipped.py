"""Fresh pictures that a program turned or mirrored: the calibration holds for them once they are put back.

Else they say that the principal point moved to the other side of the image's middle, which no glass does.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from rigkit.core.errors import DegenerateError, InputError
from rigkit.validation.sentinel.evidence import FreshView, Watched
from rigkit.validation.sentinel.judge import check_views

WAYS_TO_FLIP = {
    "turned by half a turn": (-1.0, -1.0),
    "mirrored left to right": (-1.0, 1.0),
    "mirrored top to bottom": (1.0, -1.0),
}
"""What may be done to a picture, and the signs of its axes then."""
MIN_SHARE_FLIPPED = 0.01
"""Of the longer side: a flip moves the principal point by more, or a knock may as well have moved the glass. REAL
lenses lie off the middle by 0.1 to 3.5 % (camodocal-fisheye, bouguet-stereo), and a flip doubles that."""


def flipped_pictures(watched: Watched, views: Sequence[FreshView]) -> str:
    """Return how pictures of one camera must have been flipped, where they fit once they are put back: several ways in
    words where they look the same. "" where none does, where the flip is too small to tell, and for rigs."""
    if len(watched.cameras) != 1:
        return ""
    camera = watched.cameras[0]
    off = np.array(camera.size_px) - 1.0 - 2.0 * camera.axis_px
    fit = []
    for words, signs in WAYS_TO_FLIP.items():
        moved = np.where(np.array(signs) < 0.0, off, 0.0)
        if np.linalg.norm(moved) < MIN_SHARE_FLIPPED * max(camera.size_px):
            continue
        # In a mirror a board's columns or its rows are counted backwards, as the colours of its ends have it.
        ways = (0, 1) if np.prod(signs) < 0.0 else (None,)
        if any(_fits(watched, [_put_back(view, signs, camera.size_px, way) for view in views]) for way in ways):
            fit.append(words)
    return " or ".join(fit)


def _fits(watched: Watched, views: Sequence[FreshView]) -> bool:
    try:
        return check_views(watched, views).holds
    except (DegenerateError, InputError):
        return False


def _put_back(one: FreshView, signs: tuple[float, float], size_px: tuple[int, int], backwards: int | None) -> FreshView:
    """Return a view as it was before its picture was flipped, with its columns (0) or rows (1) counted backwards."""
    view = one.view
    pixels = np.where(np.array(signs) < 0.0, np.array(size_px) - 1.0 - view.pixels, view.pixels)
    grid = view.grid.copy()
    if backwards is not None:
        grid[:, backwards] = view.board.size[backwards] - 1 - grid[:, backwards]
    return replace(one, view=replace(view, pixels=pixels, grid=grid))
