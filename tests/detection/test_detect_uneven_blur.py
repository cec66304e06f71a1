"""Boards with motion blur or far out of focus: found whole, accurate, with true sigmas."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from helpers.data import shared_data

from rigkit import detect_boards
from rigkit.core.arrays import FloatArray
from rigkit.core.boards import Board
from rigkit.detection.lattice.lattice import Lattice
from rigkit.detection.saddles.response import pyramid
from rigkit.detection.saddles.saddle import find_corners
from rigkit.detection.subpixel.blur_shape import blur_covariance
from rigkit.detection.subpixel.resampled import resampled
from rigkit.detection.subpixel.uncertain_corners import uncertain_outliers
from rigkit.detection.subpixel.uniform_blur import UNEVEN_WIDTHS
from rigkit.io.media.images import read_image

FINER, NOISE_LEVELS, LENS_PX = 4, 1.5, 0.7
COLUMNS, ROWS = 8, 6
SIZE = (230, 190)
BOARD = Board("b", COLUMNS, ROWS, 20.0, 20.0)

SMALL_SQUARES = 17.0
"""px: a motion of 15 px smears almost a whole one."""

MAX_CELLS, RATIO = 0.005, (0.4, 1.6)
"""Errors of corners (rms per axis) in squares, and over the stated sigmas: 0.0005 to 0.003 and 0.5 to 1.5 were
measured, the last of a motion over four fifths of a square."""


def moved_board(length_px: float, direction: float, turned: float, seed: int = 0) -> tuple[np.ndarray, FloatArray]:
    """Return a picture of a board that moved by `length_px` while it was taken, and its corners (N, 2).

    The board is `turned`, the motion goes into `direction`, rad. Light moves evenly: the corners are in its middle.
    """
    u, v = (((np.arange(FINER * n) + 0.5) / FINER - 0.5 - n / 2.0) / SMALL_SQUARES for n in SIZE)
    cosine, sine = np.cos(turned), np.sin(turned)
    along = cosine * u[None] + sine * v[:, None] + (COLUMNS - 1) / 2.0
    down = cosine * v[:, None] - sine * u[None] + (ROWS - 1) / 2.0
    on_board = (abs(along - (COLUMNS - 1) / 2.0) < (COLUMNS + 1) / 2.0) & (
        abs(down - (ROWS - 1) / 2.0) < (ROWS + 1) / 2.0
    )
    dark = on_board & ((np.floor(along) + np.floor(down)) % 2.0 == 0.0)
    fine = np.where(dark, 30.0, 200.0).astype(np.float32)
    steps = np.linspace(-0.5, 0.5, 2 * int(FINER * length_px) + 1) * FINER * length_px
    total = np.zeros_like(fine)
    for step in steps.tolist():
        shift = np.array([[1.0, 0.0, step * np.cos(direction)], [0.0, 1.0, step * np.sin(direction)]])
        total += cv2.warpAffine(fine, shift, fine.shape[::-1], borderMode=cv2.BORDER_REPLICATE)
    pixels = cv2.resize(total / len(steps), SIZE, interpolation=cv2.INTER_AREA)
    seen = cv2.GaussianBlur(pixels, (0, 0), LENS_PX).astype(np.float64)
    noisy = seen + np.random.default_rng(seed).normal(0.0, NOISE_LEVELS, seen.shape)
    grid = np.stack(np.meshgrid(np.arange(COLUMNS), np.arange(ROWS)), axis=-1).reshape(-1, 2)
    off = SMALL_SQUARES * (grid - 0.5 * np.array([COLUMNS - 1, ROWS - 1]))
    corners = off @ np.array([[cosine, sine], [-sine, cosine]]) + 0.5 * np.array(SIZE)
    return np.clip(np.rint(noisy), 0, 255).astype(np.uint8), corners


@pytest.mark.parametrize("reported", [True, False], ids=["size given", "size not given"])
@pytest.mark.parametrize(
    ("length_px", "direction"), [(8.0, 0.5), (12.0, 1.0), (14.0, 2.6)], ids=["8 px", "12 px", "14 px"]
)
def test_boards_smeared_by_motion_are_found_whole_and_in_place(
    length_px: float, direction: float, reported: bool
) -> None:
    image, truth = moved_board(length_px, direction, 0.2)
    (found,) = detect_boards(image, [BOARD] if reported else None)
    assert len(found.grid) >= COLUMNS * ROWS - (0 if reported else 1)
    apart = found.pixels[:, None] - truth
    nearest = np.linalg.norm(apart, axis=2).argmin(axis=1)
    assert len(set(nearest.tolist())) == len(found.grid)
    off = apart[np.arange(len(nearest)), nearest]
    assert np.sqrt((off**2).mean()) < MAX_CELLS * SMALL_SQUARES
    assert RATIO[0] < np.sqrt((off**2 / found.sigma_px[:, None] ** 2).mean()) < RATIO[1]


@pytest.mark.parametrize("turned", [0.05, 0.3])
def test_a_small_board_of_interlaced_lines_is_found_whole_and_in_place(turned: float) -> None:
    image, truth = moved_board(2.0, 0.5, turned)
    smaller, shift = 0.6, 3
    small = cv2.resize(image, None, fx=smaller, fy=smaller, interpolation=cv2.INTER_AREA)
    small[1::2] = np.roll(small[1::2], shift, axis=1)
    truth = smaller * (truth + 0.5) - 0.5 + np.array([0.5 * shift, 0.0])
    (found,) = detect_boards(small, [BOARD])
    assert len(found.grid) == COLUMNS * ROWS
    off = np.linalg.norm(found.pixels[:, None] - truth, axis=2).min(axis=1)
    assert (off < 3.0 * found.sigma_px).all()
    # Of an unknown size it is not certain enough.
    assert detect_boards(small) == ()


def lattice_of(corners: FloatArray) -> Lattice:
    pixels = corners.reshape(ROWS, COLUMNS, 2)
    return Lattice(pixels, np.full((ROWS, COLUMNS), 170.0), True)


@pytest.mark.parametrize("direction", [0.0, 0.8, 2.0])
@pytest.mark.parametrize("length_px", [0.0, 5.0, 8.0])
def test_the_shape_of_the_blur(length_px: float, direction: float) -> None:
    image, truth = moved_board(length_px, direction, 0.3)
    widths, axes = np.linalg.eigh(blur_covariance(image, lattice_of(truth), 2.0))
    if length_px == 0.0:
        assert np.sqrt(widths) == pytest.approx([LENS_PX, LENS_PX], abs=0.35)
        return
    # The Gaussian that comes nearest to an even smear is wider than its standard deviation, by a fifth.
    assert 0.9 * length_px / 12.0**0.5 < np.sqrt(widths[1]) < 1.35 * length_px / 12.0**0.5
    assert np.sqrt(widths[1] / widths[0]) > UNEVEN_WIDTHS
    assert abs(np.cos(direction) * axes[0, 1] + np.sin(direction) * axes[1, 1]) > np.cos(0.1)


@pytest.mark.parametrize("matrix", [[[0.4, -0.25], [-0.25, 0.8]], [[0.3, 0.0], [0.0, 0.3]], [[1.2, 0.1], [0.1, 0.7]]])
def test_resampled_points_map_back_to_the_image(matrix: list[list[float]]) -> None:
    _, corners = moved_board(0.0, 0.0, 0.2)
    u, v = np.meshgrid(np.arange(SIZE[0]), np.arange(SIZE[1]))
    ramp = np.asarray(40.0 + 0.5 * u + 0.2 * v, np.float32)
    part = resampled(ramp, lattice_of(corners), np.array(matrix), 9.0)
    assert part is not None
    row, column = np.mgrid[: part.grey.shape[0], : part.grey.shape[1]]
    there = part.back(np.stack([column, row], axis=-1).astype(np.float64))
    inside = ((there > 4.0) & (there < np.array(SIZE) - 5.0)).all(axis=2)
    assert inside.sum() > 1000
    expected = 40.0 + there @ np.array([0.5, 0.2])
    assert np.abs(part.grey - expected)[inside].max() < 0.02
    assert part.of(part.back(corners)) == pytest.approx(corners)


def test_a_corner_that_motion_smears_is_one() -> None:
    image, truth = moved_board(14.0, 0.2 + np.pi / 4.0, 0.2)
    corners, saddles = find_corners(pyramid(image))
    sharp, every = (
        np.linalg.norm(found[:, None] - truth, axis=2).min(axis=0, initial=np.inf) < 0.2 * SMALL_SQUARES
        for found in (corners.pixels, np.concatenate([corners.pixels, saddles.smeared.pixels]))
    )
    assert sharp.mean() < 0.6
    assert every.mean() > 0.9


def test_uncertain_corners_are_kept_where_the_others_predict_them() -> None:
    sigma, off, gain = np.full((3, 6, 8), 0.01)
    gain[:] = 1.0
    gain[5] = 2.7
    sigma[5] = 0.2
    off[5, :4], off[5, 4:] = 0.04, 0.2
    assert np.argwhere(uncertain_outliers(sigma, off, gain)).tolist() == [[5, column] for column in range(4, 8)]
    # On a board that a lens bends, predictions err by more, and those at the end of a row by the most.
    off[:5] = 0.1
    assert not uncertain_outliers(sigma, off, gain).any()


@pytest.mark.parametrize("length_px", [10.0, 15.0])
def test_real_boards_smeared_by_motion_are_found_whole(length_px: float) -> None:
    paths = [shared_data("public/hard/unsynchronised") / f"left{k}.jpg" for k in (1, 18, 27)]
    angle = np.radians(30.0)
    reach = int(np.ceil(length_px / 2.0)) + 1
    kernel = np.zeros((2 * reach + 1, 2 * reach + 1), np.float32)
    places = np.linspace(-0.5, 0.5, 801) * length_px
    for u, v in zip(
        (reach + np.cos(angle) * places).round().astype(int),
        (reach + np.sin(angle) * places).round().astype(int),
        strict=True,
    ):
        kernel[v, u] += 1.0
    for path in paths:
        moved = cv2.filter2D(read_image(path), -1, kernel / kernel.sum())
        found = detect_boards(moved, [Board("b", 9, 6, 24.23, 24.23)])
        # In all 54 but two or three at the end of a row.
        assert len(found) == 1, path
        assert len(found[0].grid) >= 51, path
