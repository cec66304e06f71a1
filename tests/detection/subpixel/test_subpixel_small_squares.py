"""Lattices of small squares next to a board: bounded cost, and no effect on the board."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from rigkit.core.arrays import FloatArray
from rigkit.detection.lattice.lattice import Lattice
from rigkit.detection.subpixel import edge_fit, subpixel
from rigkit.detection.subpixel.edge_fit import EdgeFit
from rigkit.detection.subpixel.refined import RefinedLattice
from rigkit.detection.subpixel.subpixel import MORE_EVIDENCE, refine

BLUR_PX, COLUMNS, ROWS = 1.6, 9, 6
MATRIX = np.array([[1.0, 0.1], [-0.07, 0.96]])


def drawn(image: FloatArray, origin: tuple[float, float], square_px: float) -> Lattice:
    """Draw a board of COLUMNS x ROWS corners onto `image`, the first at `origin`; return its lattice."""
    v, u = np.mgrid[: image.shape[0], : image.shape[1]].astype(float)
    x, y = np.moveaxis((np.stack([u, v], axis=-1) - origin) @ np.linalg.inv(square_px * MATRIX).T, -1, 0)
    on_board = (x > -1.0) & (x < COLUMNS) & (y > -1.0) & (y < ROWS)
    white = (np.floor(x) + np.floor(y)) % 2 == 1
    image[on_board] = np.where(white, 190.0, 40.0)[on_board]
    grid = np.stack(np.meshgrid(np.arange(COLUMNS), np.arange(ROWS)), axis=-1)
    return Lattice(grid @ (square_px * MATRIX).T + origin, np.full((ROWS, COLUMNS), 140.0), False)


@pytest.fixture(scope="module")
def scene() -> tuple[np.ndarray, Lattice, Lattice]:
    """An image of two boards, and their lattices: of squares of 26 px, and of 8 px, into whose windows the blur brings
    the edges of the neighbouring lines."""
    light = np.full((240, 420), 190.0)
    boards = drawn(light, (50.0, 50.0), 26.0), drawn(light, (325.0, 90.0), 8.0)
    noise = np.random.default_rng(3).normal(0.0, 2.0, light.shape)
    return np.clip(np.rint(cv2.GaussianBlur(light, (0, 0), BLUR_PX) + noise), 0, 255).astype(np.uint8), *boards


def fits(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """Return a list that gets the number of corners of each fit from now on."""
    counts: list[int] = []
    fit = edge_fit.fit_edges

    def counted(image: np.ndarray, pixels: FloatArray, *rest: object, **named: object) -> EdgeFit:
        counts.append(len(pixels))
        return fit(image, pixels, *rest, **named)  # type: ignore[arg-type]

    monkeypatch.setattr(subpixel, "fit_edges", counted)
    return counts


def test_the_board_is_placed_as_if_it_were_alone(scene: tuple[np.ndarray, Lattice, Lattice]) -> None:
    image, large, small = scene
    (alone,), both = refine(image, [large]), refine(image, [large, small])
    assert alone.lattice.known.all() and both[1].lattice.known.all()
    for one, other in ((alone.lattice.pixels, both[0].lattice.pixels), (alone.sigma_px, both[0].sigma_px)):
        assert np.array_equal(one, other)


def test_squares_without_promise_are_fitted_once(
    scene: tuple[np.ndarray, Lattice, Lattice], monkeypatch: pytest.MonkeyPatch
) -> None:
    image, large, small = scene
    counts = fits(monkeypatch)
    asked: list[int] = []

    def promise(item: RefinedLattice) -> float:
        asked.append(item.lattice.count)
        return -1.1 * MORE_EVIDENCE

    refined = refine(image, [large, small], promise)
    # The first pass of both; the large squares for the last time, and the small ones, where that is all.
    assert counts[0] == 108 and counts.count(54) == 2
    assert asked == [54]
    assert np.linalg.norm(refined[1].lattice.pixels - small.pixels, axis=-1).max() < 0.5
    counts.clear()
    refine(image, [large, small])
    assert counts.count(54) == 3
