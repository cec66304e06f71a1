"""Boards of squares that are small compared with the blur: all corners are fitted together."""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from detection_bench.corner_bound import corner_information, position_bound
from detection_bench.scenes import BENCH_PHOTOMETRY, BenchScene, one_board, three_boards
from scipy.special import ndtr

from rigkit import detect_boards
from rigkit.core.arrays import FloatArray
from rigkit.detection.subpixel.board_window import Surroundings, extended
from rigkit.detection.subpixel.whole_board import MAX_TILE, fit_whole_board
from rigkit.synthetic.photometry import develop
from rigkit.synthetic.render import Optics

NOISE_LEVELS, SAME_CORNER_PX = 2.0, 3.0
MAX_OF_BOUND = 0.85
"""Of the bound of single corners' windows: 0.53 to 0.67 on twelve rendered boards; the corners alone had up to 1.67."""

HONEST = (0.6, 1.2)
"""Errors over what is stated: 0.67 and 0.70 on these boards, 0.8 to 1.7 on REAL ones blurred as much."""

SCENES: dict[str, Callable[..., BenchScene]] = {"at the rim": one_board, "three": three_boards}
SEED = 1


@functools.cache
def blurred(name: str, blur_px: float) -> tuple[BenchScene, np.ndarray]:
    scene = SCENES[name](np.random.default_rng(SEED), lens="fisheye")
    photometry = replace(BENCH_PHOTOMETRY, noise_levels=NOISE_LEVELS)
    return scene, develop(scene.radiance(Optics(blur_px)), photometry, np.random.default_rng(SEED))


@pytest.mark.parametrize("name", SCENES)
def test_errors_stay_below_the_bound_of_single_corners(name: str) -> None:
    blur_px = 4.0
    scene, image = blurred(name, blur_px)
    found = detect_boards(image)
    bounds = corner_information(scene, blur_px)
    off, sigma, bound = [], [], []
    for board, information in zip(scene.truth(), bounds, strict=True):
        truth = board.pixels
        for item in found:
            away = np.linalg.norm(truth[:, None] - item.pixels, axis=2)
            nearest = away.argmin(axis=1)
            mine = away[np.arange(len(truth)), nearest] < SAME_CORNER_PX
            off.append((item.pixels[nearest] - truth)[mine])
            sigma.append(item.sigma_px[nearest][mine])
            bound.append(np.trace(position_bound(information, NOISE_LEVELS), axis1=1, axis2=2)[mine])
    squares = (np.concatenate(off) ** 2).sum(axis=1)
    assert len(squares) >= 0.98 * sum(len(board.pixels) for board in scene.truth())
    assert np.sqrt(squares.mean() / np.concatenate(bound).mean()) < MAX_OF_BOUND
    assert HONEST[0] < np.sqrt(squares.mean() / (2.0 * (np.concatenate(sigma) ** 2).mean())) < HONEST[1]


def even(size: tuple[int, int], cell_px: float) -> FloatArray:
    row, column = np.mgrid[: size[0], : size[1]]
    return np.asarray(40.0 + cell_px * np.stack([column, row], axis=2))


def picture(pixels: FloatArray, blur_px: float) -> np.ndarray:
    """Return a board of squares, on grey paper, whose corners are on straight lines."""
    last = pixels[-1, -1]
    size = (np.ceil(last) + 40).astype(int)
    steps = [np.zeros(n) for n in size]
    for axis, values in enumerate(steps):
        lines = pixels[0, :, 0] if axis == 0 else pixels[:, 0, 1]
        cell = lines[1] - lines[0]
        at = np.arange(len(values))
        for k, line in enumerate((lines[0] - cell, *lines, lines[-1] + cell)):
            weight = 1.0 if k in (0, len(lines) + 1) else 2.0
            values += (-1.0) ** k * weight * ndtr((at - line) / blur_px)
    return np.asarray(110.0 + 80.0 * np.outer(steps[1], steps[0]), np.float32)


def test_a_board_of_cut_squares_a_hole_and_one_that_goes_on(rng: np.random.Generator) -> None:
    truth = even((6, 7), 14.0)
    image = picture(truth, 3.0) + rng.normal(0.0, 1.0, (150, 164)).astype(np.float32)
    start = truth + rng.normal(0.0, 0.1, truth.shape)
    whole = fit_whole_board(image, start, 3.2, Surroundings.paper((6, 7)))
    assert whole is not None
    assert whole.residual == pytest.approx(1.0, abs=0.1)
    z = (whole.pixels - truth) / whole.spread_px[..., None]
    assert 0.75 < np.sqrt(np.mean(z**2)) < 1.25
    # A part of it, around which squares go on.
    part = Surroundings(np.full((2, 2), np.inf), np.full((2, 2), 0.5), np.zeros((4, 4), np.bool_))
    inner = fit_whole_board(image, start[1:5, 1:5], 3.2, part)
    assert inner is not None
    assert np.abs(inner.pixels - truth[1:5, 1:5]).max() < 6.0 * inner.spread_px.max()
    # Something lies on a corner.
    image[50:60, 50:60] = 30.0
    holes = np.zeros((6, 7), np.bool_)
    holes[1, 1] = True
    rest = fit_whole_board(image, start, 3.2, replace(Surroundings.paper((6, 7)), holes=holes))
    assert rest is not None
    assert np.abs(rest.pixels - truth)[~holes].max() < 6.0 * rest.spread_px[~holes].max()


def test_nothing_is_found_where_no_board_is(rng: np.random.Generator) -> None:
    start = even((5, 5), 12.0)
    flat = rng.normal(100.0, 5.0, (140, 140)).astype(np.float32)
    found = fit_whole_board(flat, start, 3.0, Surroundings.paper((5, 5)))
    assert found is None or found.spread_px.min() > 1.0
    assert fit_whole_board(flat, np.full((5, 5, 2), np.nan), 3.0, Surroundings.paper((5, 5))) is None


def test_steps_beyond_the_corners_go_on_in_proportion() -> None:
    pixels = np.stack(np.meshgrid(100.0 * 0.8 ** np.arange(4), 50.0 + 10.0 * np.arange(3)), axis=2)
    longer = extended(pixels, 2)
    assert longer.shape == (7, 8, 2)
    assert longer[3, :, 0] == pytest.approx(100.0 * 0.8 ** np.arange(-2, 6))
    assert longer[:, 3, 1] == pytest.approx(30.0 + 10.0 * np.arange(7))
    # Of a misread board two places may be one.
    pixels[1] = pixels[2]
    assert np.isfinite(extended(pixels, 2)).all()


def test_a_long_board_is_placed_in_tiles(rng: np.random.Generator) -> None:
    truth = even((6, 2 * MAX_TILE - 5), 16.0)
    light = picture(truth, 2.5)
    image = np.clip(np.rint(light + rng.normal(0.0, 2.0, light.shape)), 0, 255).astype(np.uint8)
    (found,) = detect_boards(image)
    assert len(found.grid) == truth[..., 0].size
    off = np.linalg.norm(found.pixels[:, None] - truth.reshape(-1, 2), axis=2).min(axis=1)
    ratio = off / (np.sqrt(2.0) * found.sigma_px)
    assert HONEST[0] < np.sqrt(np.mean(ratio**2)) < HONEST[1]
    # Corners by themselves have 0.033 px here, all together 0.020.
    assert np.sqrt(np.mean(off**2)) < 0.026
