"""Boards out of focus: the surroundings that blur mixes into the outermost windows do not bias corners."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
from detection_bench.corner_bound import corner_information, position_bound
from detection_bench.scenes import BENCH_PHOTOMETRY, three_boards
from detection_bench.score import FoundBoard, score
from helpers.data import shared_data

from rigkit import detect_boards
from rigkit.cameras.pinhole import Pinhole
from rigkit.core.arrays import FloatArray
from rigkit.core.boards import Board
from rigkit.io.media.images import read_image
from rigkit.synthetic.photometry import develop
from rigkit.synthetic.render import Optics

NOISE_LEVELS = 2.0
SUPERSAMPLED = 8
CELL_PX, COLUMNS, ROWS = 30.0, 7, 5
SAME_PX = 1e-9
"""By which a corner moves that is fitted with others in one call: not at all."""

MAX_PER_BLUR = 0.015
"""Of the blur, by which a corner may lie aside: where squares are cut at 3 blurs, half of it was measured."""


def cut_board(ends: tuple[float, float, float, float], blur_px: float, margin: float) -> tuple[np.ndarray, FloatArray]:
    """Return a picture of a board seen straight on, and its corners (N, 2).

    `ends` is how wide the outer squares are on the left, right, top, bottom, in squares; then comes paper of brightness
    `margin`, as wide as a square, and something darker.
    """
    size = (380, 300)
    u, v = (
        ((np.arange(n * SUPERSAMPLED) + 0.5) / SUPERSAMPLED - 0.5 - 80.25 - 0.125 * k) / CELL_PX
        for k, n in enumerate(size)
    )
    left, right, top, bottom = ends
    square = (np.floor(u)[None] + np.floor(v)[:, None]) % 2.0 == 0.0
    on_board = (u > -left) & (u < COLUMNS - 1 + right)
    on_board = on_board[None] & ((v > -top) & (v < ROWS - 1 + bottom))[:, None]
    paper = (u > -left - 1.0) & (u < COLUMNS + right)
    paper = paper[None] & ((v > -top - 1.0) & (v < ROWS + bottom))[:, None]
    fine = np.where(on_board, np.where(square, 30.0, 200.0), np.where(paper, margin, 90.0)).astype(np.float32)
    pixels = cv2.resize(fine, size, interpolation=cv2.INTER_AREA)
    blurred = cv2.GaussianBlur(pixels, (0, 0), blur_px).astype(np.float64)
    image = blurred + np.random.default_rng(0).normal(0.0, 0.5, blurred.shape)
    corners = np.stack(np.meshgrid(np.arange(COLUMNS), np.arange(ROWS)), axis=-1).reshape(-1, 2)
    return np.clip(np.rint(image), 0, 255).astype(np.uint8), 80.25 + np.array([0.0, 0.125]) + CELL_PX * corners


@pytest.mark.parametrize(
    ("ends", "margin"),
    [
        ((1.0, 1.0, 1.0, 1.0), 200.0),
        ((0.45, 1.0, 0.6, 1.0), 200.0),
        ((0.5, 0.4, 0.5, 0.4), 200.0),
        ((1.0, 0.7, 1.0, 0.6), 110.0),
    ],
    ids=["whole", "cut on two sides", "cut on all", "grey margin"],
)
@pytest.mark.parametrize("blur_px", [2.0, 3.0, 4.0])
def test_truncated_squares_do_not_bias_corners(
    ends: tuple[float, float, float, float], margin: float, blur_px: float
) -> None:
    image, truth = cut_board(ends, blur_px, margin)
    (found,) = detect_boards(image)
    assert len(found.grid) == COLUMNS * ROWS
    off = np.linalg.norm(found.pixels[:, None] - truth, axis=2).min(axis=1)
    # Noise alone makes 0.01 px; without a model of what lies beyond, corners lie 0.14 to 2.4 px aside.
    assert off.max() < MAX_PER_BLUR * blur_px


@pytest.mark.parametrize("blur_px", [2.0, 3.0])
def test_truncated_squares_do_not_bias_guided_corners(blur_px: float) -> None:
    image, truth = cut_board((0.45, 1.0, 0.6, 1.0), blur_px, 200.0)
    camera = Pinhole((image.shape[1], image.shape[0]), np.array([800.0, 800.0, 190.0, 150.0]))
    (found,) = detect_boards(image, [Board("b", COLUMNS, ROWS, 30.0, 30.0)], camera=camera)
    off = np.linalg.norm(found.pixels[:, None] - truth, axis=2).min(axis=1)
    assert len(found.grid) == COLUMNS * ROWS
    assert off.max() < MAX_PER_BLUR * blur_px


@pytest.mark.parametrize(
    ("lens", "blur_px", "most"),
    [
        ("regular", 2.0, 1.2),
        pytest.param("regular", 4.0, 1.2, marks=pytest.mark.slow),
        pytest.param("fisheye", 3.0, 1.2, marks=pytest.mark.slow),
        ("fisheye", 4.0, 1.2),
    ],
)
def test_errors_out_of_focus_are_near_the_bound(lens: str, blur_px: float, most: float) -> None:
    scene = three_boards(np.random.default_rng(0), lens=lens)
    light = scene.radiance(Optics(blur_px))
    photometry = replace(BENCH_PHOTOMETRY, noise_levels=NOISE_LEVELS)
    image = np.asarray(develop(light, photometry, np.random.default_rng(0)))
    every = score(scene, [FoundBoard.of(found) for found in detect_boards(image)])
    assert every.complete == every.boards
    bounds = np.concatenate([position_bound(x, NOISE_LEVELS) for x in corner_information(scene, blur_px)])
    bound = float(np.sqrt(np.trace(bounds, axis1=1, axis2=2).mean()))
    assert every.rms_px < most * bound


@pytest.mark.parametrize(
    ("blur_px", "every"),
    [
        # Five images of the 28, of both cameras: all of them take longer than any other test.
        pytest.param(5.0, 6, id="5.0-few"),
        *(pytest.param(blur, 1, id=str(blur), marks=pytest.mark.thorough) for blur in (1.5, 2.0, 3.0, 4.0, 5.0)),
    ],
)
def test_real_boards_out_of_focus_are_found_whole(blur_px: float, every: int) -> None:
    paths = sorted(shared_data("real/bouguet-stereo").glob("*.jpg"))
    assert len(paths) == 28
    whole = 0
    for path in paths[::every]:
        found = detect_boards(cv2.GaussianBlur(read_image(path), (0, 0), blur_px))
        whole += any(sorted((b.columns, b.rows)) == [6, 9] and b.complete for b in found)
    assert whole == len(paths[::every])


def test_a_blurred_board_does_not_change_a_sharp_one() -> None:
    """Whether what lies beyond the outer squares matters is asked of each board by itself."""
    sharp, _ = cut_board((0.45, 1.0, 1.0, 1.0), 0.8, 200.0)
    soft, corners = cut_board((1.0, 1.0, 1.0, 1.0), 2.5, 120.0)
    alone, beside = detect_boards(np.hstack([sharp, np.full_like(soft, 90)])), detect_boards(np.hstack([sharp, soft]))
    assert [len(alone), len(beside)] == [1, 2]
    again = min(beside, key=lambda one: float(one.pixels[:, 0].max()))
    assert len(corners) - ROWS <= len(again.pixels) == len(alone[0].pixels)
    assert np.abs(again.pixels - alone[0].pixels).max() < SAME_PX
