"""The largest rectangle that is seen whole, against trying all of them."""

from __future__ import annotations

import numpy as np
import pytest

from rigkit.cameras.pinhole import Pinhole
from rigkit.rectification.crop import cropped, largest_rectangle
from rigkit.rectification.rectify import RectifyMap


def brute(seen: np.ndarray) -> int:
    """The area of the largest rectangle of True, by trying all."""
    total = np.zeros((seen.shape[0] + 1, seen.shape[1] + 1), dtype=int)
    total[1:, 1:] = seen.cumsum(axis=0).cumsum(axis=1)
    best = 0
    for top in range(seen.shape[0]):
        for bottom in range(top + 1, seen.shape[0] + 1):
            for left in range(seen.shape[1]):
                for right in range(left + 1, seen.shape[1] + 1):
                    area = (bottom - top) * (right - left)
                    whole = total[bottom, right] - total[top, right] - total[bottom, left] + total[top, left] == area
                    best = max(best, area if whole else 0)
    return best


def test_the_rectangle_is_the_largest(rng: np.random.Generator) -> None:
    for share in (0.3, 0.8, 0.95):
        seen = rng.random((13, 17)) < share
        left, top, right, bottom = largest_rectangle(seen)
        assert seen[top:bottom, left:right].all()
        assert (bottom - top) * (right - left) == brute(seen)


def test_a_disk_of_any_size_gives_the_square_in_it() -> None:
    for radius in (90, 700):
        v, u = np.mgrid[-radius : radius + 1, -radius : radius + 1]
        left, top, right, bottom = largest_rectangle(np.hypot(u, v) <= radius)
        assert np.hypot(u, v)[top:bottom, left:right].max() <= radius
        # The square has 2 r^2; a cell of the coarse grid may be lost before it grows.
        assert (bottom - top) * (right - left) == pytest.approx(2.0 * radius**2, rel=0.02)


def test_what_the_coarse_cells_leave_is_taken_too() -> None:
    assert largest_rectangle(np.ones((601, 703), dtype=bool)) == (0, 0, 703, 601)
    # The coarse cells at all four sides are lost, each for its outermost row or column alone.
    framed = np.zeros((601, 703), dtype=bool)
    framed[1:-1, 1:-1] = True
    assert largest_rectangle(framed) == (1, 1, 702, 600)


def test_nothing_seen_is_nothing() -> None:
    assert largest_rectangle(np.zeros((40, 50), dtype=bool)) == (0, 0, 0, 0)


def test_a_cropped_target_shows_the_same_directions() -> None:
    """One camera sees neither the target's left nor its top, the other not its right and bottom."""
    target = Pinhole((90, 70), np.array([80.0, 85.0, 44.5, 34.5]))
    seeing = [Pinhole((90, 70), np.array([80.0, 85.0, 44.5 + u, 34.5 + v])) for u, v in ((-10.0, -5.0), (8.0, 3.0))]
    maps = [RectifyMap(camera, target, np.eye(3)) for camera in seeing]
    parts = cropped(maps)
    for whole, part in zip(maps, parts, strict=True):
        assert part.target.size_px == (90 - 10 - 8, 70 - 5 - 3)
        pixels = np.array([[0.0, 0.0], [71.0, 61.0], [20.0, 50.0]])
        np.testing.assert_allclose(
            part.source_pixels(pixels)[0], whole.source_pixels(pixels + np.array([10.0, 5.0]))[0]
        )
        assert part.coverage().all()
