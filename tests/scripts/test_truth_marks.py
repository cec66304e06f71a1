"""Marks on a printed cylinder: found at their true places, and compared with the design."""

from __future__ import annotations

import sys
from itertools import product

import cv2
import numpy as np
import pytest
from helpers.data import REPOSITORY

from rigkit.core.errors import DegenerateError
from rigkit.geometry.rotation import exp_so3

sys.path.insert(0, str(REPOSITORY / "scripts"))

from truth.marks import fit_similarity, lattice_affinities, mark_lattice

ROWS, COLUMNS, STEP_PX, HALF_PX = 6, 5, 60.0, 9.0
MAX_CENTRE_PX = 0.05
"""Corners are drawn at sixteenths of a pixel, in 8 bits: up to .044 px remain."""
MAX_CURVED = 1.5e-4
"""Of affinities of about one: differences of the nearest marks alone are off by five times that."""
OVERSAMPLING = 16


def drawn(turn: float) -> tuple[np.ndarray, np.ndarray]:
    """Return a bright page with a lattice of dark squares, and their centres (COLUMNS, ROWS, 2)."""
    across, down = np.array([np.cos(turn), np.sin(turn)]), np.array([-np.sin(turn), np.cos(turn)])
    column, row = np.meshgrid(np.arange(COLUMNS), np.arange(ROWS), indexing="ij")
    centres = np.array([110.3, 90.7]) + STEP_PX * (column[..., None] * across + row[..., None] * down)
    large = np.zeros((480 * OVERSAMPLING, 480 * OVERSAMPLING), np.uint8)
    cv2.rectangle(large, (320, 320), (large.shape[1] - 320, large.shape[0] - 320), 220, -1)
    for centre in centres.reshape(-1, 2):
        corners = centre + HALF_PX * np.array([-across - down, across - down, across + down, down - across])
        cv2.fillConvexPoly(large, np.round((corners + 0.5) * OVERSAMPLING - 0.5).astype(np.int32), 30)
    return cv2.resize(large, (480, 480), interpolation=cv2.INTER_AREA), centres


@pytest.mark.parametrize("turn", [0.0, 0.08])
def test_marks_are_found_where_they_are(turn: float) -> None:
    image, centres = drawn(turn)
    start = (2, 0)
    found = mark_lattice(image, centres[start] + [4.0, -5.0], ROWS)
    assert len(found) == ROWS * COLUMNS
    for (column, row), pixel in found.items():
        assert np.linalg.norm(pixel - centres[column + start[0], row]) < MAX_CENTRE_PX
    assert len(mark_lattice(image, centres[start], ROWS - 2)) == (ROWS - 2) * COLUMNS


def test_affinities_are_those_of_the_map() -> None:
    A = np.array([[0.9, 0.1], [-0.05, 1.1]])
    marks = {(c, r): np.array([50.0 * c + 3.0 * r, 60.0 * r]) for c in range(6) for r in range(5)}
    moved = {key: A @ pixel + 7.0 for key, pixel in marks.items()}
    keys, pixels1, pixels2, A21 = lattice_affinities(marks, moved)
    assert keys == [(2, 2), (3, 2)]
    assert np.allclose(A21, A)
    assert np.allclose(pixels2, pixels1 @ A.T + 7.0)
    with pytest.raises(DegenerateError, match="two neighbours on each side"):
        lattice_affinities(marks, {})


def test_affinities_of_a_surface_that_bends() -> None:
    """Marks every 12 degrees around a cylinder, from two directions and near: as the tangent has them."""

    def marks(part: float, turn: float) -> dict[tuple[int, int], np.ndarray]:
        out = {}
        for column, row in product(range(-2, 3), repeat=2):
            around = part * np.radians(12.0) * column - turn
            depth = 400.0 - 57.0 * np.cos(around)
            out[column, row] = 2000.0 / depth * np.array([57.0 * np.sin(around), 12.0 * part * row])
        return out

    (found,), (exact,) = (lattice_affinities(marks(part, -0.5), marks(part, 0.4))[3] for part in (1.0, 1e-3))
    assert np.abs(found - exact).max() < MAX_CURVED


def test_images_without_marks_are_reported() -> None:
    with pytest.raises(DegenerateError, match="no dark mark"):
        mark_lattice(np.full((100, 100), 200, np.uint8) * np.uint8(1), np.zeros(2), 3)


def test_similarity_is_undone(rng: np.random.Generator) -> None:
    points = rng.normal(size=(20, 3))
    rotation = exp_so3(np.array([0.3, -2.0, 0.4]))
    to = 57.0 * points @ rotation.T + [1.0, 2.0, 3.0]
    fit = fit_similarity(points, to)
    assert np.allclose(fit.apply(points), to)
    assert np.isclose(fit.scale, 57.0)
    assert np.allclose(fit.rotation, rotation)
    # A mirror image is no rotation: it must not be fitted as one.
    assert np.linalg.det(fit_similarity(points, to * [1.0, 1.0, -1.0]).rotation) > 0.0
    with pytest.raises(DegenerateError, match="line"):
        fit_similarity(np.outer(np.arange(5.0), [1.0, 2.0, 3.0]), to[:5])
