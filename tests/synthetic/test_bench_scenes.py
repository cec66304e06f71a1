"""Benchmark scenes: what is promised is in the image, for both lenses."""

from __future__ import annotations

import numpy as np
import pytest

from rigkit.boards import Board
from rigkit.errors import InputError
from rigkit.synthetic.bench_scenes import (
    LENSES,
    SCENES,
    bench_camera,
    empty,
    one_board,
    partial_board,
    room,
    three_boards,
)


@pytest.mark.parametrize("lens", LENSES)
def test_whole_boards_are_whole(lens: str, rng: np.random.Generator) -> None:
    assert [len(d.grid) for d in one_board(rng, lens=lens).truth()] == [100]
    assert [d.complete for d in three_boards(rng, lens=lens).truth()] == [True] * 3
    full = room(rng, lens=lens, count=8)
    assert [d.complete for d in full.truth()] == [True] * 8
    boxes = np.array([[d.pixels.min(axis=0), d.pixels.max(axis=0)] for d in full.truth()])
    for a in range(8):
        for b in range(a):
            apart = (boxes[a, 0] > boxes[b, 1]) | (boxes[b, 0] > boxes[a, 1])
            assert apart.any(), "two boards overlap"


@pytest.mark.parametrize("lens", LENSES)
def test_partial_boards_are_cut_and_empty_scenes_are_empty(lens: str, rng: np.random.Generator) -> None:
    scene = partial_board(rng, lens=lens)
    (found,) = scene.truth()
    assert 0.33 * 88 < len(found.grid) < 0.9 * 88
    assert found.columns * found.rows == 88
    assert empty(rng, lens=lens).truth() == ()


def test_square_size_and_image_size_are_kept(rng: np.random.Generator) -> None:
    scene = one_board(rng, board=Board("b", 7, 5, 25.0, 25.0), square_px=12.0, max_tilt_deg=1.0, size_px=(800, 600))
    (found,) = scene.truth()
    side = np.linalg.norm(np.diff(found.lattice(), axis=1), axis=-1)
    assert abs(side.mean() / 12.0 - 1.0) < 0.05
    assert scene.render(noise_levels=3.0, rng=rng).shape == (600, 800)


def test_scenes_are_reproducible_and_lenses_are_known() -> None:
    for make in (SCENES["three"], SCENES["partial"]):
        first, second = (make(np.random.default_rng(3), size_px=(320, 240)).render() for _ in range(2))
        np.testing.assert_array_equal(first, second)
    with pytest.raises(InputError, match="known: regular, fisheye"):
        bench_camera("telephoto")
