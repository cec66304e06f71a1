"""Later searches of an image: only corners that the boards found before do not explain lead to one."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from detection_bench.scenes import one_board

from rigkit.core.boards import Board
from rigkit.detection import lattices
from rigkit.detection.checks.validate import has_edge_offset
from rigkit.detection.detect import detect_boards
from rigkit.detection.lattice.lattice import Lattice
from rigkit.detection.new_corners import SAME_PX, new_corners, same_corner_px
from rigkit.detection.saddles.response import Level, grey_image
from rigkit.detection.searched_image import SearchedImage
from rigkit.detection.subpixel.refined import RefinedLattice

STEP_PX = 20.0


def board_with_a_hole() -> RefinedLattice:
    """Return a lattice of 6 x 5 corners from pixel (200, 100) on, STEP_PX apart, without that of column 2 and row 3."""
    pixels = np.stack(np.meshgrid(np.arange(6.0), np.arange(5.0)), axis=-1) * STEP_PX + (200.0, 100.0)
    pixels[3, 2] = np.nan
    one = np.where(np.isnan(pixels[..., 0]), np.nan, 1.0)
    return RefinedLattice(Lattice(pixels, one, True), 0.1 * one, one, one, one)


def test_corners_of_a_board_found_before_are_not_new() -> None:
    found = board_with_a_hole()
    new, may_belong = new_corners([found], found.lattice.pixels[found.lattice.known] + 1.0)
    assert not new.any()
    assert not may_belong


@pytest.mark.parametrize(
    ("cell", "belongs"), [((2.0, 3.0), True), ((6.1, 2.0), True), ((-1.0, -1.0), True), ((9.0, 2.0), False)]
)
def test_a_corner_in_a_hole_or_next_to_a_board_may_belong_to_it(cell: tuple[float, float], belongs: bool) -> None:
    pixel = np.array([cell]) * STEP_PX + (200.0, 100.0)
    new, may_belong = new_corners([board_with_a_hole()], pixel)
    assert new.all()
    assert may_belong is belongs


def test_the_same_corner_is_within_a_tenth_of_a_large_cell() -> None:
    lattice = board_with_a_hole().lattice
    assert same_corner_px(lattice) == SAME_PX
    assert same_corner_px(replace(lattice, pixels=15.0 * lattice.pixels)) == pytest.approx(1.5 * STEP_PX)


def test_a_corner_next_to_a_board_that_is_mostly_covered_may_belong_to_it() -> None:
    # Of most empty places nothing is predicted.
    pixels = np.stack(np.meshgrid(np.arange(22.0), np.arange(22.0)), axis=-1) * STEP_PX + (200.0, 100.0)
    pixels[3:, 3:] = np.nan
    one = np.where(np.isnan(pixels[..., 0]), np.nan, 1.0)
    found = RefinedLattice(Lattice(pixels, one, True), 0.1 * one, one, one, one)
    assert new_corners([found], np.array([[3.5, 7.0]]) * STEP_PX + (200.0, 100.0))[1]
    assert not new_corners([found], np.array([[0.4, 0.3]]))[1]


def test_coarser_levels_are_left_once_one_shows_nothing_new(
    rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch
) -> None:
    levels: list[int] = []
    coarser = SearchedImage.coarser

    def counted(self: SearchedImage, without: int) -> SearchedImage | None:
        levels.append(without)
        return coarser(self, without)

    monkeypatch.setattr(SearchedImage, "coarser", counted)
    image = one_board(rng, board=Board("b", 8, 6, 30.0, 30.0)).render(noise_levels=2.0, rng=rng)
    (found,) = detect_boards(image, [Board("larger", 9, 7, 30.0, 30.0)])
    assert found.complete and not found.board_id
    assert levels == [1] and len(SearchedImage.of(grey_image(image)).levels) > 2


@pytest.mark.parametrize(("columns", "rows", "times"), [(9, 6, 1), (20, 14, 2)])
def test_edges_are_tested_once_but_of_boards_that_were_tested_before_they_were_grown(
    columns: int, rows: int, times: int, rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch
) -> None:
    tested: list[int] = []

    def counted(lattice: Lattice, finest: Level) -> bool:
        tested.append(lattice.count)
        return has_edge_offset(lattice, finest)

    monkeypatch.setattr(lattices, "has_edge_offset", counted)
    board = Board("b", columns, rows, 30.0, 30.0)
    image = one_board(rng, board=board, square_px=20.0, max_tilt_deg=20.0).render(noise_levels=2.0, rng=rng)
    (found,) = detect_boards(image, [board])
    assert found.complete
    assert len(tested) == times and tested[-1] == columns * rows


def test_a_whole_board_of_another_size_is_searched_for_once(
    rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch
) -> None:
    searches: list[SearchedImage] = []
    search = lattices.candidate_lattices

    def counted(at: SearchedImage, min_corners: int, plausible: lattices.IsPlausible) -> list[Lattice]:
        searches.append(at)
        return search(at, min_corners, plausible)

    monkeypatch.setattr(lattices, "candidate_lattices", counted)
    scene = one_board(rng, board=Board("b", 8, 6, 30.0, 30.0))
    image = scene.render(noise_levels=2.0, rng=rng)
    (found,) = detect_boards(image, [Board("larger", 9, 7, 30.0, 30.0)])
    assert (found.columns, found.rows) == (8, 6)
    assert len(searches) == 1
