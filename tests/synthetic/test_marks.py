"""Marks are painted where they are, and nowhere is one cut off."""

from __future__ import annotations

from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest

from rigkit.geometry.rotation import exp_so3
from rigkit.synthetic.raycast import Surface, _cells, _inside, _paint_marks

PER_PIXEL = 4
ROUNDING = 1e-6
"""Of single precision, some marks added up."""


@pytest.mark.parametrize("turned", [(0.0, 0.0, 0.0), (0.0, 0.0, 0.6), (0.3, 0.1, 1.2)])
def test_what_is_painted_near_each_mark_is_what_is_painted_everywhere(
    turned: tuple[float, float, float], rng: np.random.Generator
) -> None:
    """The pixels that a mark meets are chosen, to save time; all that its edges reach has to be among them."""
    y, x = np.mgrid[: 40 * PER_PIXEL, : 30 * PER_PIXEL] / PER_PIXEL
    space = np.stack([x - 15.0, y - 20.0, np.full_like(x, 60.0)]).reshape(3, -1)
    rotation = exp_so3(np.array(turned))
    seen = (rotation[:, :2].T @ space * (60.0 / (rotation[:, 2] @ space))).reshape(2, *x.shape)
    axes = (0.1 * seen).astype(np.float32)
    places = np.array([(u, v) for u in range(-3, 3) for v in range(-3, 3)])
    marks = np.hstack([places + rng.uniform(0.0, 0.4, places.shape), rng.uniform(0.05, 0.5, places.shape)])
    surface = cast(Surface, SimpleNamespace(marks=marks, black=0.1, white=0.9))
    cells = [_cells(axis, PER_PIXEL) for axis in axes]

    painted = np.full(axes.shape[1:], 0.9, dtype=np.float32)
    _paint_marks(painted, axes, cells, surface)
    whole = np.full(axes.shape[1:], 0.9, dtype=np.float32)
    for left, top, width, height in marks:
        whole += (
            np.float32(-0.8)
            * _inside(axes[0], cells[0], left, left + width)
            * _inside(axes[1], cells[1], top, top + height)
        )
    assert np.abs(painted - whole).max() < ROUNDING
    assert painted.min() < 0.15
