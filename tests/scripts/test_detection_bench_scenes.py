"""Scenes of the detection benchmark show what they promise, for both lenses."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from detection_bench.blanks import BLANKS, blank
from detection_bench.scenes import (
    CONDITIONS,
    LENSES,
    SCENES,
    bench_camera,
    covered_board,
    empty,
    one_board,
    partial_board,
    room,
    small_board,
    three_boards,
)

from rigkit.core.boards import Board
from rigkit.core.errors import InputError


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


def test_small_boards_are_whole_and_small(rng: np.random.Generator) -> None:
    scene = small_board(rng, lens="fisheye", square_px=5.0)
    (found,) = scene.truth()
    assert found.complete
    side = [np.linalg.norm(np.diff(found.lattice(), axis=axis), axis=-1) for axis in (0, 1)]
    assert 4.0 < min(s.mean() for s in side) < 5.3


@pytest.mark.parametrize("name", BLANKS)
def test_blank_pictures_are_sharp_and_reproducible(name: str, rng: np.random.Generator) -> None:
    picture = blank(name, rng, (320, 240))
    assert picture.shape == (240, 320)
    assert picture.dtype == np.uint8
    assert picture.std() > 15.0
    first, again = (blank(name, np.random.default_rng(1), (160, 120)) for _ in range(2))
    np.testing.assert_array_equal(first, again)
    with pytest.raises(InputError, match="known: noise"):
        blank("chessboard", rng)


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


def test_a_ruler_hides_part_of_a_board(rng: np.random.Generator) -> None:
    scene = covered_board(rng)
    (found,), (clear,) = scene.truth(), scene.clear()
    assert found.complete
    hidden = 0
    image = scene.render(blur_px=0.3)
    for (u, v), is_clear in zip(np.rint(found.pixels).astype(int), clear, strict=True):
        patch = image[v - 2 : v + 3, u - 2 : u + 3].astype(int)
        # A corner has black and white round it, a ruler is one grey.
        plain = patch.max() - patch.min() < 40
        hidden += int(plain)
        assert not (plain and is_clear)
    assert 2 <= hidden <= 30


@pytest.mark.parametrize("name", list(CONDITIONS))
def test_every_condition_leaves_a_readable_board(name: str) -> None:
    optics, photometry = CONDITIONS[name]
    rng = np.random.default_rng(5)
    scene = one_board(rng, size_px=(320, 240), board=Board("b", 5, 4, 30.0, 30.0))
    image = scene.render(optics=optics, photometry=photometry, rng=rng)
    assert image.dtype == (np.uint16 if name == "16 bit" else np.uint8)
    grey = np.clip(image / (257.0 if name == "16 bit" else 1.0), 0, 255).astype(np.uint8)
    (found,) = scene.truth()
    corners = found.pixels.astype(np.float32).reshape(-1, 1, 2)
    refined = cv2.cornerSubPix(grey, corners.copy(), (3, 3), (-1, -1), (3, 50, 1e-4))
    assert np.median(np.linalg.norm(refined - corners, axis=2)) < 0.25
