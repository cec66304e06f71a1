"""Boards that are hard to see are accepted, patterns that resemble boards are not; lens distortion is no scatter."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import cv2
import numpy as np
import pytest
from detection_bench.blanks import blank
from detection_bench.scenes import CONDITIONS, one_board

from rigkit.core.boards import Board
from rigkit.core.patterns.charuco import Charuco
from rigkit.detection.checks.evidence import OF_NOISE, SCORE, Evidence
from rigkit.detection.checks.validate import without_shared_corners
from rigkit.detection.detect import detect_boards
from rigkit.detection.lattice.lattice import Lattice
from rigkit.detection.saddles.response import grey_image
from rigkit.detection.subpixel.refined import RefinedLattice
from rigkit.detection.subpixel.scatter import excess_scatter, scatter_factors

BOARD = Board("board", 9, 6, 30.0, 30.0)
CORNERS = BOARD.corner_count

FAR_FACTOR = 1.6
"""Estimates of the scatter of some fifty corners lie within this factor of the truth."""

HEAT_ERROR_PX = 0.1
"""RMS error of corners in the rendered heat image: its noise, relative to the board's contrast, is 0.05."""


def rendered(seed: int, **options: Any) -> np.ndarray:
    scene = one_board(
        np.random.default_rng(seed), board=BOARD, max_tilt_deg=30.0, square_px=options.pop("square_px", 40)
    )
    photometry = replace(CONDITIONS["plain"][1], **{k: v for k, v in options.items() if k != "blur_px"})
    image = scene.render(rng=np.random.default_rng(seed), blur_px=options.get("blur_px", 0.7), photometry=photometry)
    return np.asarray(image)


@pytest.mark.parametrize(
    "options",
    [
        {"square_px": 9.0, "noise_levels": 4.0, "blur_px": 1.2},
        {"sharpen": 4.0, "noise_levels": 2.0, "blur_px": 1.5},
        {"blur_px": 5.0, "noise_levels": 3.0},
    ],
    ids=["small", "sharpened", "blurred"],
)
def test_boards_seen_badly_are_found(options: dict[str, float]) -> None:
    found = [detect_boards(rendered(seed, **options)) for seed in range(3)]
    assert [[len(item.grid) for item in boards] for boards in found] == [[CORNERS]] * 3


def test_no_single_measure_decides() -> None:
    board = Evidence(0.002, 1.5, 0.05, 0.05)
    assert board.score > 0.0
    for name in Evidence._fields:
        worse = board._replace(**{name: 2.0 * getattr(board, name)})
        assert worse.score < board.score
        assert worse.score > 0.0
    assert Evidence(*(4.0 * np.array(board))).score < 0.0


@pytest.mark.parametrize(
    ("name", "seed"),
    [("gingham", 207), ("gingham", 326), ("gingham", 347), ("gingham", 415), ("staggered", 323)],
)
def test_what_only_coarser_levels_show_is_no_board(name: str, seed: int) -> None:
    """There are saddles between the crossings of stripes, where the image is uniform, and between discs, whose edges
    are off the lines of the saddles."""
    assert not detect_boards(blank(name, np.random.default_rng(seed)))


@pytest.mark.parametrize(
    ("name", "seed", "board"),
    [
        ("staggered", 316, None),
        ("staggered", 316, Board("plain", 8, 6, 60.0, 60.0)),
        ("tartan", 611, Board("marked", 8, 6, 60.0, 60.0, pattern=Charuco("DICT_5X5_100", 45.0))),
    ],
)
def test_what_passes_with_few_corners_is_judged_again(name: str, seed: int, board: Board | None) -> None:
    """Of discs the first corners seem to be those of squares, of stripes the scatter is known after the last fit."""
    boards = None if board is None else [board]
    assert not detect_boards(grey_image(blank(name, np.random.default_rng(seed))), boards)


def fitted(contrast: np.ndarray) -> RefinedLattice:
    """Corners 20 px apart with these contrasts, each fitted with noise of 2 grey levels and no other residuals."""
    rows, columns = contrast.shape
    every = np.ones(contrast.shape)
    lattice = replace(grid(rows, columns, (0.0, 0.0)), contrast=contrast)
    return RefinedLattice(lattice, 0.05 * every, 0.7 * every, 2.0 * every, 2.0 * every)


def test_corners_of_one_board_have_similar_contrasts(rng: np.random.Generator) -> None:
    shaded = 50.0 * np.exp(0.12 * np.add.outer(np.arange(6), np.arange(9)))
    board = Evidence.of(fitted(shaded))
    assert board.contrast_change == pytest.approx(0.12) and board.score > 0.0
    # A faint corner, or one under a lamp, is no evidence against a board.
    shaded[2, 3], shaded[4, 4] = 3.0, 900.0
    assert Evidence.of(fitted(shaded)).score == pytest.approx(board.score, abs=0.1)
    # Contrasts by chance are.
    assert Evidence.of(fitted(rng.permutation(np.geomspace(10.0, 400.0, 54)).reshape(6, 9))).score < board.score - 5.0


def test_noise_hides_other_residuals() -> None:
    faint = Evidence.of(fitted(np.full((6, 9), 2.0)))
    assert faint.excess_residual == pytest.approx(OF_NOISE)
    assert faint.score < Evidence.of(fitted(np.full((6, 9), 50.0))).score - 3.0


def test_every_measure_is_weighed_and_large_ones_count_against_a_board() -> None:
    assert tuple(SCORE) == Evidence._fields
    assert all(weight < 0.0 for weight in SCORE.values())


def test_a_heat_image_with_a_faint_board_beside_something_hot() -> None:
    scene = one_board(np.random.default_rng(3), board=BOARD, max_tilt_deg=30.0, square_px=30)
    grey = scene.render(blur_px=1.0).astype(np.float64)
    rng = np.random.default_rng(4)
    # Of the range of 16 bits the board has a fiftieth.
    heat = 3000.0 + 6.0 * grey + 30.0 * rng.standard_normal(grey.shape)
    heat[:, :120] = 52000.0
    image = np.clip(cv2.GaussianBlur(heat, (0, 0), 0.7), 0, 65535).astype(np.uint16)
    (found,) = detect_boards(image)
    (truth,) = scene.truth()
    nearest = np.linalg.norm(found.pixels[:, None] - truth.pixels, axis=2).min(axis=1)
    assert len(found.grid) == CORNERS
    assert np.sqrt(np.mean(nearest**2)) < HEAT_ERROR_PX


def grid(rows: int, columns: int, first_px: tuple[float, float]) -> Lattice:
    v, u = np.mgrid[:rows, :columns] * 20.0
    return Lattice(np.stack([u, v], axis=-1) + first_px, np.full((rows, columns), 100.0), True)


def test_a_grid_that_grew_over_a_seam_keeps_its_own_corners() -> None:
    large, grown, again = grid(8, 8, (0.0, 0.0)), grid(7, 8, (0.0, 140.0)), grid(6, 7, (20.0, 20.0))
    kept = without_shared_corners([again, grown, large], 9)
    assert [item.size for item in kept] == [(8, 8), (8, 6)]
    assert not np.isclose(kept[1].pixels[..., 1], 140.0).any()


def strong_bend(noise_px: float) -> tuple[np.ndarray, np.ndarray]:
    """Corners (6, 7, 2) as a mirror sees them, 0.8 radians a cell apart, and their noise (6, 7)."""
    row, column = np.mgrid[:6, :7].astype(np.float64)
    azimuth, radius = 0.8 * column, 120.0 * np.exp(0.5 * row)
    pixels = np.stack([radius * np.cos(azimuth), radius * np.sin(azimuth)], axis=-1)
    return pixels + noise_px * np.random.default_rng(5).standard_normal(pixels.shape), np.full((6, 7), 0.05)


def test_lens_distortion_does_not_count_as_scatter() -> None:
    everything = [(slice(0, 6), slice(0, 7))]
    pixels, sigma_px = strong_bend(0.05)
    along, both = excess_scatter(pixels, sigma_px, everything)[0], scatter_factors(pixels, sigma_px, everything)[0]
    assert along > 5.0
    assert both < 0.5 * along
    pixels, sigma_px = strong_bend(2.0)
    assert scatter_factors(pixels, sigma_px, everything)[0] == pytest.approx(2.0 / 0.05, rel=FAR_FACTOR - 1.0)
