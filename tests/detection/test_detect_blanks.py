"""Pictures without a board: nothing is found, and clutter is abandoned early."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from detection_bench.blanks import BLANKS, blank
from detection_bench.scenes import one_board

from rigkit.detection import lattices as lattices_of_images
from rigkit.detection.checks.validate import has_edge_offset, is_compact
from rigkit.detection.detect import detect_boards
from rigkit.detection.lattice import grow
from rigkit.detection.lattice.lattice import Lattice
from rigkit.detection.saddles.response import grey_image, pyramid
from rigkit.detection.subpixel.subpixel import refine

MAX_FITTED = 1200
"""Corners that are fitted there in vain: about as many as twelve boards have."""

SIZE_PX = (640, 480)


@pytest.mark.parametrize("name", BLANKS)
def test_nothing_is_found_and_work_is_bounded(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    fitted: list[int] = []
    grown: list[int] = []
    grow_one = grow._grown

    def counted_refine(image: np.ndarray, lattices: list[Lattice], *rest: object, **named: object) -> object:
        fitted.extend(item.count for item in lattices)
        return refine(image, lattices, *rest, **named)  # type: ignore[arg-type]

    def counted_growth(lattice: Lattice, *rest: object) -> tuple[Lattice, bool]:
        out = grow_one(lattice, *rest)  # type: ignore[arg-type]
        grown.append(out[0].count)
        return out

    monkeypatch.setattr(lattices_of_images, "refine", counted_refine)
    monkeypatch.setattr(grow, "_grown", counted_growth)
    for seed in range(4):
        fitted.clear()
        grown.clear()
        assert detect_boards(blank(name, np.random.default_rng(seed), SIZE_PX)) == (), f"seed {seed}"
        assert len(grown) <= grow.MAX_GROWN
        assert sum(fitted) <= MAX_FITTED


def lattice_of(rows: list[str], side_px: float = 20.0, first_px: tuple[float, float] = (100.0, 100.0)) -> Lattice:
    """Return a lattice of squares of `side_px` with a corner where `rows` show a #."""
    known = np.array([[sign == "#" for sign in row] for row in rows])
    v, u = np.mgrid[: known.shape[0], : known.shape[1]] * side_px
    pixels = np.where(known[..., None], np.stack([u, v], axis=-1) + first_px, np.nan)
    return Lattice(pixels, np.where(known, 100.0, np.nan), True)


@pytest.mark.parametrize(
    ("rows", "solid", "whole"),
    [
        (["###", "###", "###", "###"], True, True),
        (["####", "####", "#.##", "####"], True, True),
        (["#########", "#########", ".........", "##.......", "#########"], True, True),
        (["#...", "##..", "##..", "##..", ".#..", ".###", ".###", ".###"], True, False),
        (["###...", "###...", "...###", "...###", "...#.#"], True, False),
        (["######", "##...#", "##..##"], False, False),
        (["####", "####"], True, True),
    ],
)
def test_chance_makes_chains_and_boards_have_blocks(rows: list[str], solid: bool, whole: bool) -> None:
    for lattice in (lattice_of(rows), lattice_of([*map("".join, zip(*rows, strict=True))])):
        assert lattice.solid == solid
        assert is_compact(lattice, SIZE_PX) == whole


def test_what_the_frame_cuts_off_is_not_missing() -> None:
    cut = ["######", "#####.", "####..", "###...", "##....", "#....."]
    assert not is_compact(lattice_of(cut), SIZE_PX)
    inside = lattice_of(cut, first_px=(0.0, 0.0))
    turned = inside.pixels @ (np.array([[1.0, -1.0], [1.0, 1.0]]) / np.sqrt(2.0))
    at_the_right = Lattice(turned + np.array([630.0 - np.nanmax(turned[..., 0]), 240.0]), inside.contrast, True)
    assert is_compact(at_the_right, SIZE_PX)


def test_edges_of_dots_lean_and_those_of_boards_do_not(rng: np.random.Generator) -> None:
    scene = one_board(rng)
    (truth,) = scene.truth()
    board = Lattice(truth.lattice(), np.full((truth.rows, truth.columns), 100.0), True)
    image = scene.render(rng=rng)
    bright = np.clip(1.7 * image.astype(np.float32), 0.0, 255.0)
    for picture in (image, bright, 255.0 - image.astype(np.float32)):
        level = pyramid(grey_image(picture))[0]
        either = [Lattice(board.pixels, board.contrast, rising) for rising in (True, False)]
        assert [has_edge_offset(item, level) for item in either].count(False) >= 1
    # Discs that nearly touch, and the middles of the gaps between two of them.
    page = np.full(SIZE_PX[::-1], 205, np.uint8)
    for v in range(40, 440, 30):
        for u in range(40, 600, 30):
            cv2.circle(page, (u, v), 14, 25, -1, cv2.LINE_AA)
    step = np.array([[15.0, 15.0], [-15.0, 15.0]])
    grid = np.stack(np.meshgrid(np.arange(6), np.arange(6)), axis=-1)
    gaps = Lattice(grid @ step + np.array([215.0, 100.0]), np.full((6, 6), 100.0), True)
    assert has_edge_offset(gaps, pyramid(grey_image(page))[0])
