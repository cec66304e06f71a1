"""Lattices: rotation and cropping keep the colours of the squares and agree with `BoardDetection`."""

from __future__ import annotations

import numpy as np
import pytest

from rigkit.core.detections import BoardDetection
from rigkit.detection.lattice.lattice import Lattice
from rigkit.detection.lattice.local_fit import fit_cells
from rigkit.detection.lattice.split import join_parts, split_at_turns, split_necks

ROUNDING_PX = 1e-6
"""Normal equations of a 7x7 neighbourhood with their slight ridge."""


def lattice(columns: int, rows: int, *, rising: bool = True) -> Lattice:
    row, column = np.mgrid[:rows, :columns].astype(float)
    pixels = np.stack([50.0 + 20.0 * column + 3.0 * row, 40.0 + 25.0 * row - 2.0 * column], axis=-1)
    return Lattice(pixels, np.full((rows, columns), 100.0), rising)


@pytest.mark.parametrize("quarter", range(4))
def test_turned_as_a_detection_is(quarter: int) -> None:
    before = lattice(5, 4)
    row, column = np.nonzero(before.known)
    grid = np.stack([column, row], axis=-1)
    detection = BoardDetection(None, 5, 4, grid, before.pixels[row, column], np.ones(20)).turned(quarter)
    turned = before.turned(quarter)
    assert turned.size == (detection.columns, detection.rows)
    assert np.array_equal(turned.pixels, detection.lattice())


@pytest.mark.parametrize("quarter", range(4))
@pytest.mark.parametrize("size", [(5, 4), (4, 4), (5, 3)])
def test_turning_keeps_the_squares(quarter: int, size: tuple[int, int]) -> None:
    """The square between +column and +row of a corner keeps its colour; its sign flips with each quarter turn."""
    before = lattice(*size)
    turned = before.turned(quarter)
    for at, sign in zip(turned.pixels.reshape(-1, 2), turned.signs().ravel(), strict=True):
        old = np.argwhere((before.pixels == at).all(axis=2))[0]
        assert sign == before.signs()[tuple(old)] * (-1) ** quarter


def test_cut_keeps_the_signs() -> None:
    before = lattice(6, 5)
    for top, left in ((0, 1), (1, 0), (2, 1), (1, 1)):
        part = before.cut(slice(top, 5), slice(left, 6))
        assert np.array_equal(part.signs(), before.signs()[top:, left:])


def test_local_fit_of_a_cubic_is_exact_at_the_border() -> None:
    row, column = np.mgrid[:6, :7].astype(float)
    u = 20.0 * column + 0.3 * column**2 - 0.05 * column**3 + 0.1 * column * row**2
    v = 22.0 * row - 0.2 * row**2 + 0.04 * row**3 + 0.2 * column * row
    known = np.ones((6, 7), bool)
    fit = fit_cells(np.stack([u, v], axis=-1), known)
    assert np.abs(fit.pixels - np.stack([u, v], axis=-1)[known]).max() < 1e3 * ROUNDING_PX
    slope = 20.0 + 0.6 * column - 0.15 * column**2 + 0.1 * row**2
    assert np.abs(fit.along_column[:, 0] - slope[known]).max() < 1e4 * ROUNDING_PX
    assert np.abs(fit.curvature_column[:, 0] - (0.6 - 0.3 * column)[known]).max() < 1e4 * ROUNDING_PX


def test_curvature_of_a_circle() -> None:
    """Rows on circles about (0, 500): columns turn from u to v, so they bend towards +90 degrees, by 1 / radius."""
    row, column = np.mgrid[:5, :7].astype(float)
    angle = np.radians(3.0) * (column - 3.0)
    radius = 300.0 - 20.0 * row
    pixels = np.stack([radius * np.sin(angle), 500.0 - radius * np.cos(angle)], axis=-1)
    fit = fit_cells(pixels, np.ones((5, 7), bool))
    assert np.abs(fit.curvature()[:, 0] * radius.ravel() - 1.0).max() < 0.01
    assert np.abs(fit.curvature()[:, 1]).max() < 1e-6


def test_fold_is_cut_and_smooth_bending_is_not() -> None:
    row, column = np.mgrid[:6, :13].astype(float)
    u = np.where(column <= 6, 20.0 * column, 120.0 + 14.0 * (column - 6))
    v = 20.0 * row + np.where(column <= 6, 0.0, 9.0 * (column - 6))
    folded = Lattice(np.stack([u, v], axis=-1), np.ones((6, 13)), True)
    assert sorted(part.size for part in split_at_turns(folded)) == [(6, 6), (6, 6)]
    angle = np.radians(7.0) * (column - 6.0)
    bent = np.stack([(200.0 + 20 * row) * np.sin(angle), (200.0 + 20 * row) * np.cos(angle)], axis=-1)
    assert len(split_at_turns(Lattice(bent, np.ones((6, 13)), True))) == 1


def test_parts_join_across_a_lost_row_in_any_rotation() -> None:
    whole = lattice(7, 6)
    upper = whole.cut(slice(0, 3), slice(0, 7))
    lower = whole.cut(slice(4, 6), slice(0, 7))
    for quarter in range(4):
        (joined,) = join_parts([upper, lower.turned(quarter)])
        assert joined.count == 35
        assert joined.size == (7, 6)
        assert np.array_equal(joined.signs(), whole.signs())


def test_parts_of_the_wrong_colours_do_not_join() -> None:
    whole = lattice(7, 6)
    lower = whole.cut(slice(4, 6), slice(0, 7))
    wrong = Lattice(lower.pixels, lower.contrast, not lower.rising)
    assert len(join_parts([whole.cut(slice(0, 3), slice(0, 7)), wrong])) == 2


def test_boards_that_touch_at_an_odd_angle_are_parted_at_the_neck() -> None:
    """Two boards, the second turned by 12 degrees, with a pair of corners between them that belongs to neither."""
    row, column = np.mgrid[:6, :5].astype(float)
    first = np.stack([20.0 * column, 20.0 * row], axis=-1)
    turn = np.radians(12.0)
    second = first @ np.array([[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]]) + [122.0, -24.0]
    pixels = np.full((6, 11, 2), np.nan)
    pixels[:, :5], pixels[:, 6:] = first, second
    pixels[2:4, 5] = 0.5 * (first[2:4, 4] + second[2:4, 0])
    whole = Lattice(pixels, np.ones((6, 11)), True)
    parts = split_necks(whole)
    assert len(parts) == 2
    for part, board in zip(parts, (first, second), strict=True):
        inside = (np.abs(board[:, :, None, None] - part.pixels).max(axis=-1) == 0.0).any(axis=(2, 3))
        assert inside.all()
    assert sum(part.count for part in parts) <= 62


def test_holes_do_not_part_a_board() -> None:
    """Covered in places so that its closed squares fall apart: one board with all corners that are left."""
    board = lattice(7, 5)
    covered = np.zeros((5, 7), bool)
    covered[[0, 1, 3, 4, 1, 3], [3, 3, 3, 3, 1, 5]] = True
    (part,) = split_necks(board.without(covered))
    assert part.count == 29
    assert part.size == (7, 5)


def test_an_outlying_corner_is_dropped() -> None:
    board = lattice(7, 5)
    corner = np.zeros((5, 7), bool)
    corner[0, 1:] = True
    loose = board.without(corner)
    loose.pixels[0, 0] += [4.0, -4.0]
    (part,) = split_necks(loose)
    assert part.size == (7, 4)
    assert part.count == 28


def test_parts_join_across_a_ruler_in_a_fisheye() -> None:
    """Rows that bend strongly: no homography carries the one part over to the other, but smooth rows do."""
    row, column = np.mgrid[:8, :9].astype(float)
    plane = np.stack([0.12 * (column - 1.0), 0.12 * (row - 2.0)], axis=-1)
    radius = np.maximum(np.linalg.norm(plane, axis=-1, keepdims=True), 1e-9)
    pixels = 320.0 + 250.0 * np.arctan(radius) * plane / radius
    whole = Lattice(pixels, np.full((8, 9), 100.0), True)
    left, right = whole.cut(slice(0, 8), slice(0, 4)), whole.cut(slice(0, 8), slice(5, 9))
    (joined,) = join_parts([left, right])
    assert joined.count == 64
    assert joined.size == (9, 8)
    moved = Lattice(right.pixels + np.array([0.0, 6.0]), right.contrast, right.rising)
    assert len(join_parts([left, moved])) == 2
