"""Half-covered boards: the visible part is found, without false corners."""

from __future__ import annotations

from dataclasses import replace
from itertools import product

import cv2
import numpy as np
import pytest
from detection_bench.scenes import covered_board, one_board
from measure_covers import Score, cover, laid_over, scored

from rigkit.core.boards import Board
from rigkit.core.patterns.charuco import Charuco
from rigkit.detection.detect import detect_boards
from rigkit.detection.lattice.lattice import Lattice
from rigkit.detection.lattice.local_fit import fit_cells
from rigkit.detection.subpixel.consistent import without_inconsistent
from rigkit.detection.subpixel.refined import RefinedLattice
from rigkit.synthetic.render import Optics

BOARD = Board("b", 8, 6, 30.0, 30.0)
MARKED = Board("b", 7, 7, 30.0, 30.0, pattern=Charuco("DICT_4X4_100", 22.5))
SEEDS = 6

MAX_OF_IT = 0.75
"""Of the corners in view: of 36 boards 0.8 are found."""


def covered(seed: int, lens: str, kind: str, board: Board = BOARD, noise_levels: float = 2.0) -> Score:
    """Return what is found of a board half of which is covered."""
    rng = np.random.default_rng(seed)
    scene = one_board(rng, lens=lens, board=board)
    image = np.asarray(scene.render(rng=rng, blur_px=0.7, noise_levels=noise_levels), np.uint8)
    (truth,) = scene.truth()
    sides = fit_cells(truth.lattice(), np.isfinite(truth.lattice()[..., 0])).cell_px()
    mask = cover(image, truth.pixels, float(np.median(sides)), kind, 0.5, rng)
    return scored(list(detect_boards(laid_over(image, mask, kind, rng), [board])), truth.pixels, sides, mask)


def test_the_visible_part_of_covered_boards_is_found_and_nothing_else() -> None:
    total = Score()
    for lens, kind, seed in product(("regular", "fisheye"), ("flat", "texture", "hand"), range(SEEDS)):
        total.add(covered(seed, lens, kind))
    assert total.false == 0
    assert total.images == 6 * SEEDS
    assert total.found > MAX_OF_IT * total.in_view


@pytest.mark.parametrize(("seed", "lens"), [(18, "fisheye"), (44, "fisheye"), (51, "regular")])
def test_corners_with_something_else_in_their_windows_are_not_claimed(seed: int, lens: str) -> None:
    """Of 240 such boards five had a false corner."""
    assert covered(seed, lens, "texture").false == 0


@pytest.mark.parametrize("seed", [0, 2])
def test_strips_of_a_board_on_both_sides_of_an_arm_are_known_by_their_markers(seed: int) -> None:
    """The larger strip, not compact, has two rows and three corners of a third."""
    board, rng = replace(MARKED, columns=6, rows=8), np.random.default_rng(seed)
    scene = one_board(rng, board=board, max_tilt_deg=20.0)
    image = np.asarray(scene.render(optics=Optics(0.7, supersample=2), noise_levels=2.0, rng=rng), np.uint8)
    (truth,) = scene.truth()
    pixel_from_grid, _ = cv2.findHomography(truth.grid.astype(np.float64), truth.pixels)
    arm = np.array([[[-2.0, 1.2], [9.0, 3.4], [9.0, 6.9], [-2.0, 4.7]]])
    cv2.fillPoly(image, [np.rint(cv2.perspectiveTransform(arm, pixel_from_grid)[0]).astype(np.int32)], [130.0])
    (found,) = detect_boards(image, [board])
    assert found.board_id == board.board_id
    off = np.hypot(*(found.pixels - truth.lattice()[tuple(found.grid[:, ::-1].T)]).T)
    # Two corners are partly under the arm.
    assert np.sort(off)[-3] < 0.03
    assert off.max() < 1.0


def test_parts_of_a_board_beside_a_wide_ruler_in_a_fisheye_are_joined() -> None:
    """Their nearest cells differ in size and shape."""
    rng = np.random.default_rng(1)
    scene = covered_board(rng, lens="fisheye")
    (ruler,), (truth,) = scene.occluders, scene.truth()
    wide = replace(scene, occluders=(replace(ruler, height_mm=1.5 * 30.0),))
    (found,) = detect_boards(np.asarray(wide.render(noise_levels=2.0, rng=rng), np.uint8))
    assert (found.columns, found.rows) == (10, 10) and len(found.grid) > 60

    def nearest(pixels: np.ndarray) -> tuple[np.ndarray, float]:
        off = np.linalg.norm(pixels[:, None] - truth.pixels, axis=2)
        return truth.grid[off.argmin(axis=1)], float(off.min(axis=1).max())

    assert nearest(found.pixels)[1] < 0.2
    assert any(np.array_equal(one.grid, nearest(one.pixels)[0]) for one in map(found.turned, range(4)))


@pytest.mark.parametrize(("seed", "lens"), [(7, "regular"), (0, "fisheye")])
def test_textures_on_noisy_boards_with_markers_have_no_corners(seed: int, lens: str) -> None:
    """Noise is as much as most textures leave: these two of 16 such boards had a false corner."""
    assert covered(seed, lens, "texture", MARKED, noise_levels=12.0).false == 0


@pytest.mark.parametrize("seed", [0, 3])
def test_outer_ends_of_squares_are_no_corners_of_a_row_that_is_not_there(seed: int) -> None:
    rng = np.random.default_rng(seed)
    scene = one_board(rng, lens="regular", board=MARKED)
    image = np.asarray(scene.render(rng=rng, blur_px=0.7, noise_levels=12.0), np.uint8)
    (found,) = detect_boards(image, [replace(MARKED, rows=8)])
    assert found.board_id == "b"
    assert found.grid[:, 1].max() == 6
    assert len(found.grid) == 49


def test_a_corner_that_has_no_other_beside_it_is_dropped() -> None:
    pixels = 20.0 * np.stack(np.meshgrid(np.arange(9.0), np.arange(6.0)), axis=-1)
    known = np.arange(9) < 6 * np.ones((6, 1))
    known[4:, 8] = True
    lone = known.copy()
    lone[0, 8] = True
    pixels[~lone] = np.nan
    ones = np.where(lone, 1.0, np.nan)
    item = RefinedLattice(Lattice(pixels, 100.0 * ones, True), 0.02 * ones, 0.8 * ones, 2.0 * ones, 2.0 * ones)
    assert np.array_equal(without_inconsistent(item, [(slice(6), slice(9))]).lattice.known, known)
