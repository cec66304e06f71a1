"""The kernels that model the image of a whole board, against closed forms in numpy."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.special import ndtr

from rigkit.detection.subpixel.board_window import extended
from rigkit.detection.subpixel.whole_board import spline_coefficients
from rigkit.kernels.boards import (
    Shares,
    block_products,
    board_picture,
    board_places,
    move_blocks,
    share_blocks,
    sheet_places,
)

PLACED = 1e-5
"""Newton's method ends that near, in squares."""
DRAWN = 2e-3
"""Of the contrast: Mehler's series ends with the third power of the cosine, here 0.2; float32 has 1e-6."""
SIZE = (4, 5)
"""Rows and columns of corners."""
WIDTH, HEIGHT = 90, 76
MATRIX = np.array([[11.0, 1.2], [0.9, 10.5]])
FIRST = np.array([18.3, 15.6])
ENDS = np.array([[-1.0, 4.6], [-0.8, 4.0]])
PAPER = np.array([0.3, -0.4, 0.8, 0.1])


def nodes_of(moves: np.ndarray | float = 0.0) -> np.ndarray:
    """Return (R + 4, C + 4, 2) nodes of a board, even but for `moves`: two rings around its corners included."""
    row, column = np.mgrid[: SIZE[0], : SIZE[1]]
    return extended(FIRST + np.stack([column, row], axis=2) @ MATRIX + moves, 2)


def places_of(moves: np.ndarray | float = 0.0) -> np.ndarray:
    return board_places(spline_coefficients(nodes_of(moves)), (0, 0, WIDTH, HEIGHT), 0.25) - 2.0


def test_places_are_those_of_an_even_board() -> None:
    u, v = np.meshgrid(np.arange(WIDTH), np.arange(HEIGHT))
    truth = (np.stack([u, v], axis=2) - FIRST) @ np.linalg.inv(MATRIX)
    found = places_of()
    inside = ((truth > -1.99) & (truth < np.array([5.99, 4.99]))).all(axis=2)
    assert np.abs(found - truth)[inside].max() < PLACED
    outside = ((truth < -2.01) | (truth > np.array([6.01, 5.01]))).any(axis=2)
    assert np.isnan(found[outside]).all()


def test_places_of_a_bent_board_are_seen_where_they_are_looked_for(rng: np.random.Generator) -> None:
    moves = rng.normal(0.0, 0.3, (*SIZE, 2))
    nodes, found = nodes_of(moves), places_of(moves)
    for row, column in np.ndindex(SIZE):
        at = nodes[row + 2, column + 2]
        near = np.rint(at).astype(int)
        # Between a corner and the pixel beside it the map is nearly straight.
        off = found[near[1], near[0]] + (at - near) @ np.linalg.inv(MATRIX) - (column, row)
        assert np.abs(off).max() < 0.01


def drawn(places: np.ndarray, blur: float) -> np.ndarray:
    """Return the picture of squares and paper by the normal distribution, without what blur does along two normals."""
    slopes = np.linalg.norm(np.linalg.inv(MATRIX), axis=0)
    values = []
    for axis, (ends, lines) in enumerate(zip(ENDS, SIZE[::-1], strict=True)):
        steps = [
            (ends[0], 1.0),
            *((k, 2.0 if k % 2 else -2.0) for k in range(lines)),
            (ends[1], 1.0 if lines % 2 else -1.0),
        ]
        edges = [ndtr((places[..., axis] - at) / slopes[axis] / blur) for at, _ in steps]
        squares = sum(weight * edge for (_, weight), edge in zip(steps, edges, strict=True))
        values.append((squares, 1.0 - edges[0], edges[-1]))
    (one, left, right), (two, above, below) = values
    along, down = 1.0 - 0.5 * (left + right), 1.0 - 0.5 * (above + below)
    beyond = (left * down, right * down, along * above, along * below)
    return np.asarray(one * two + sum(level * part for level, part in zip(PAPER, beyond, strict=True)))


def test_the_picture_is_that_of_blurred_squares_on_paper(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(globals(), "MATRIX", np.diag([11.0, 10.5]))
    places = places_of()
    picture = board_picture(places, SIZE, ENDS, PAPER, 0.7)
    assert np.abs(picture[0] - drawn(places, 0.7))[seen(places)].max() < DRAWN


def seen(places: np.ndarray) -> np.ndarray:
    """Return (H, W) which pixels, and those beside them, have a place on the board."""
    known = np.isfinite(places).all(axis=2)
    out = np.zeros_like(known)
    out[1:-1, 1:-1] = np.all(
        [known[1 + v : HEIGHT - 1 + v, 1 + u : WIDTH - 1 + u] for v in (-1, 0, 1) for u in (-1, 0, 1)], axis=0
    )
    return out


def test_planes_are_how_the_picture_changes() -> None:
    places, step = places_of(), 0.01
    planes, known = board_picture(places, SIZE, ENDS, PAPER, 0.7), seen(places)
    for side in range(4):
        more = PAPER + step * (np.arange(4) == side)
        change = (board_picture(places, SIZE, ENDS, more, 0.7)[0] - planes[0]) / step
        assert np.abs(change - planes[3 + side])[known].max() < DRAWN
        outwards = np.where(np.arange(4) == side, (-step, step, -step, step), 0.0).reshape(2, 2)
        both = [board_picture(places, SIZE, ENDS + way * outwards, PAPER, 0.7)[0] for way in (1.0, -1.0)]
        change = (both[0] - both[1]) / (2.0 * step)
        # Blur along both normals is left out of this one.
        assert np.abs(change - planes[7 + side])[known].max() < 0.15 * np.abs(change[known]).max()
    inner = (slice(24, 50), slice(24, 60))
    for axis, plane in ((1, planes[1]), (0, planes[2])):
        slope = np.gradient(planes[0], axis=axis)
        # A difference over 2 px of edges of 0.7 px is less steep than they are.
        assert np.corrcoef(slope[inner].ravel(), plane[inner].ravel())[0, 1] > 0.97


def test_moves_are_how_the_blurred_picture_changes() -> None:
    places = places_of()
    planes = board_picture(places, SIZE, ENDS, PAPER, 0.7)
    taps = np.exp(-0.5 * (np.arange(-6, 7) / 2.0) ** 2).astype(np.float32)
    taps /= taps.sum()
    corners = Shares.at(places, SIZE, spacing=1.0, beyond=1.5, cubic=True, margin=6)
    blocks = move_blocks(corners, planes[1:3], np.ones((HEIGHT, WIDTH), np.float32), taps)

    def blurred(moves: np.ndarray) -> np.ndarray:
        picture = board_picture(places_of(moves), SIZE, ENDS, PAPER, 0.7)[0]
        rows = np.apply_along_axis(np.convolve, 1, picture, taps, "same")
        return np.asarray(np.apply_along_axis(np.convolve, 0, rows, taps, "same"))

    node, step = 1 * SIZE[1] + 2, 0.05
    left, top, right, bottom = blocks.boxes[node]
    used = np.asarray(((places > -0.5) & (places < np.array([4.5, 3.5]))).all(axis=2))[
        top : bottom + 1, left : right + 1
    ]
    for axis in (0, 1):
        moves = np.zeros((*SIZE, 2))
        moves[1, 2, axis] = step
        change = ((blurred(moves) - blurred(-moves)) / (2.0 * step))[top : bottom + 1, left : right + 1]
        start = int(blocks.starts[node]) + axis * change.size
        found = blocks.data[start : start + change.size].reshape(change.shape)
        # Far from a corner the spline goes on as the cubic does not.
        assert np.abs(found - change)[used].max() < 0.12 * np.abs(change).max()


def test_products_are_those_of_all_changes(rng: np.random.Generator) -> None:
    places = places_of()
    shares = Shares.at(places, (3, 3), spacing=2.0, beyond=0.5, cubic=False, margin=0)
    corners = Shares.at(places, SIZE, spacing=1.0, beyond=1.5, cubic=True, margin=0)
    groups = [
        share_blocks(corners, rng.normal(size=(2, HEIGHT, WIDTH)).astype(np.float32)),
        share_blocks(shares, rng.normal(size=(3, HEIGHT, WIDTH)).astype(np.float32)),
    ]
    rest = rng.normal(size=(HEIGHT, WIDTH)).astype(np.float32)
    rows = []
    for group in groups:
        for box, start in zip(group.boxes, group.starts, strict=True):
            left, top, right, bottom = box
            for k in range(group.each):
                picture, shape = np.zeros((HEIGHT, WIDTH)), (bottom - top + 1, right - left + 1)
                first = start + k * shape[0] * shape[1]
                picture[top : bottom + 1, left : right + 1] = group.data[first : first + shape[0] * shape[1]].reshape(
                    shape
                )
                rows.append(picture.ravel())
    dense = np.array(rows)
    products, right_side = block_products(groups, rest)
    # Sums of float32 over some thousand pixels.
    assert products == pytest.approx(dense @ dense.T, rel=1e-5, abs=1e-2)
    assert right_side == pytest.approx(dense @ rest.ravel(), rel=1e-5, abs=1e-2)


def test_values_between_nodes_are_linear() -> None:
    places = places_of()
    shares = Shares.at(places, (3, 3), spacing=2.0, beyond=0.5, cubic=False, margin=0)
    row, column = np.mgrid[:3, :3]
    (seen,) = shares.interpolated((3.0 + 2.0 * column - row)[None].astype(np.float64))
    inside = ((places > -0.5) & (places < np.array([4.5, 3.5]))).all(axis=2)
    truth = 3.0 + places[..., 0] - 0.5 * places[..., 1]
    assert np.abs(seen - truth)[inside].max() < 1e-4


def test_the_picture_alone_is_that_of_all_planes() -> None:
    places = places_of()
    for paper in (PAPER, np.zeros(4)):
        alone = board_picture(places, SIZE, ENDS, paper, 0.7, planes=1)
        assert np.array_equal(alone[0], board_picture(places, SIZE, ENDS, paper, 0.7)[0])


def test_places_on_a_sheet_and_beside_corners(rng: np.random.Generator) -> None:
    places, first, each = places_of(), np.array([-2.0, -1.0]), 16
    corners, reach = rng.random((2, *SIZE)) < 0.7, np.array([0.45, 0.3])
    found, near = sheet_places(places, first, each, corners, reach)
    known = np.isfinite(places).all(axis=2)
    assert np.array_equal(found[:, known], ((places[known] - first) * each - 0.5).astype(np.float32).T)
    assert (found[:, ~known] < -each).all()
    nearest = np.rint(places[known]).astype(np.int64).clip(0, np.array(SIZE[::-1]) - 1)
    off = np.abs(places[known] - nearest).max(axis=1)
    for kind in range(2):
        assert np.array_equal(near[kind][known], corners[kind][nearest[:, 1], nearest[:, 0]] & (off < reach[kind]))
        assert not near[kind][~known].any()
