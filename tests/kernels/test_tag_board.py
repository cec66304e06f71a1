"""The corners of boards of tags: the kernels' rounds against their definition in numpy."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from detection_bench.scenes import one_board
from helpers.data import read_grey, shared_data
from kernels.reference import edges as reference_edges
from kernels.reference import tag_board as reference

from rigkit.cameras.base import Camera
from rigkit.core.boards import Board
from rigkit.core.detections import BoardDetection, grid_turned
from rigkit.core.patterns.aprilgrid import AprilGrid
from rigkit.detection.detect import detect_boards
from rigkit.detection.lattice.lattice import Lattice
from rigkit.detection.tags.corners import tag_corners
from rigkit.detection.tags.placing import squares_of, voted_place
from rigkit.detection.targets import aprilgrid
from rigkit.kernels.edges import fit_corners
from rigkit.kernels.tag_board import tag_heights

KALIBR = Board("k", 10, 8, 60.0, 60.0, pattern=AprilGrid(0.3))
ALONE = Board("k", 10, 8, 60.0, 60.0, pattern=AprilGrid(0.3, corner_squares=False))

LEVEL_STEP_PX = 1e-5
"""numpy reads the contrast that the corners of lone tags start from with a thirty-second of a pixel (OpenCV), which is
felt where the last step ends: it may be 0.01 px, and what is left after it is a hundredth of a step."""


def compared(
    image: np.ndarray, board: Board, monkeypatch: pytest.MonkeyPatch, camera: Camera | None = None, missing: float = 0.0
) -> int:
    """Return how many corners were found, the same by the kernels and by numpy; rough ones are `missing` in part."""
    monkeypatch.setattr(reference_edges, "fit_corners", fit_corners)
    found = 0

    def both(image: np.ndarray, tags: Any, pixels: np.ndarray, camera: Camera | None) -> BoardDetection | None:
        nonlocal found
        rough = pixels.copy()
        rough[np.random.default_rng(7).random(rough.shape[:2]) < missing] = np.nan
        ours, theirs = (function(image, tags, rough, camera) for function in (ours_of, reference.tag_corners))
        assert (ours is None) == (theirs is None)
        if ours is not None and theirs is not None:
            np.testing.assert_array_equal(ours.grid, theirs.grid)
            np.testing.assert_allclose(ours.pixels, theirs.pixels, atol=LEVEL_STEP_PX)
            np.testing.assert_allclose(ours.sigma_px, theirs.sigma_px, rtol=1e-4)
            found += len(ours.grid)
        return ours

    ours_of: Callable[..., BoardDetection | None] = tag_corners
    monkeypatch.setattr(aprilgrid, "tag_corners", both)
    detect_boards(image, [board], camera=camera)
    return found


@pytest.mark.parametrize("lens", ["regular", "fisheye"])
@pytest.mark.parametrize("board", [KALIBR, ALONE], ids=["kalibr", "tags alone"])
def test_corners_of_rendered_boards(
    board: Board, lens: str, rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch
) -> None:
    scene = one_board(rng, lens=lens, board=board)
    assert compared(scene.render(supersample=2, noise_levels=2.0, rng=rng), scene.boards[0].board, monkeypatch) >= 79


@pytest.mark.parametrize("missing", [0.6, 0.8])
def test_missing_corners_are_found_by_the_same_rounds(
    missing: float, rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch
) -> None:
    scene = one_board(rng, lens="fisheye", board=KALIBR)
    image = scene.render(blur_px=2.0, supersample=2, noise_levels=2.0, rng=rng)
    assert compared(image, scene.boards[0].board, monkeypatch, missing=missing) >= 40


def test_noise_that_neighbours_share(rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch) -> None:
    scene = one_board(rng, lens="regular", board=KALIBR)
    image = cv2.GaussianBlur(scene.render(supersample=2, noise_levels=6.0, rng=rng), (0, 0), 0.8)
    assert compared(image, scene.boards[0].board, monkeypatch) >= 79


def test_a_camera_tells_the_same_corners(rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch) -> None:
    scene = one_board(rng, lens="fisheye", board=KALIBR)
    image = scene.render(supersample=2, noise_levels=2.0, rng=rng)
    assert compared(image, scene.boards[0].board, monkeypatch, camera=scene.camera, missing=0.5) >= 70


def test_corners_beside_what_covers_them(rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch) -> None:
    scene = one_board(rng, lens="regular", board=KALIBR)
    image = scene.render(supersample=2, noise_levels=2.0, rng=rng)
    u, v = (int(part) for part in scene.truth()[0].pixels.mean(axis=0))
    image[v - 12 : v + 12, u - 60 : u + 60] = 128
    assert compared(image, scene.boards[0].board, monkeypatch) >= 40


def test_corners_of_photographs(monkeypatch: pytest.MonkeyPatch) -> None:
    folder: Path = shared_data("public/aprilgrid-mocap/cam0/data")
    for path in sorted(folder.glob("*.jpg"))[::10]:
        for squares in (True, False):
            board = Board("m", 12, 12, 88.0, 88.0, pattern=AprilGrid(0.3, corner_squares=squares))
            with monkeypatch.context() as patch:
                assert compared(read_grey(path), board, patch) >= 70


def lattice_of(rng: np.random.Generator, rising: bool) -> Lattice:
    pixels = np.stack(np.meshgrid(np.arange(7.0), np.arange(5.0)), axis=-1) + rng.normal(0.0, 0.1, (5, 7, 2))
    pixels[1, 2] = pixels[4, 6] = np.nan
    return Lattice(pixels, np.ones((5, 7)), rising)


@pytest.mark.parametrize("rising", [True, False])
@pytest.mark.parametrize("dark", [True, False])
def test_squares_of_a_lattice(rising: bool, dark: bool, rng: np.random.Generator) -> None:
    lattice = lattice_of(rng, rising)
    quads, cells = squares_of(lattice, dark=dark)
    wanted_quads, wanted = reference.squares_of(lattice, dark=dark)
    assert 8 <= len(wanted) <= 12
    np.testing.assert_array_equal(cells, wanted)
    np.testing.assert_array_equal(quads, wanted_quads)


@pytest.mark.parametrize("turn", range(4))
def test_most_tags_tell_the_place_and_others_do_not(turn: int, rng: np.random.Generator) -> None:
    lattice = lattice_of(rng, True)
    _, cells = squares_of(lattice, dark=True)
    places = grid_turned(cells, (6, 4), turn) + np.array([4, -2])
    turns = np.full(len(cells), -turn % 4)
    places[:3] += rng.integers(-2, 3, (3, 2))
    turns[3:5] = rng.integers(0, 4, 2)
    votes, projected, shift = voted_place(lattice, cells, turns, places)
    wanted = reference.voted_place(lattice, cells, turns, places)
    assert (votes, projected, shift.tolist()) == (wanted[0], wanted[1], wanted[2].tolist())
    assert (projected, shift.tolist()) == (turn, [4, -2])


def test_ties_between_places_go_to_the_first(rng: np.random.Generator) -> None:
    lattice = lattice_of(rng, True)
    for _ in range(30):
        cells, places = rng.integers(0, 3, (2, 6, 2))
        turns = rng.integers(0, 4, 6)
        ours, theirs = (f(lattice, cells, turns, places) for f in (voted_place, reference.voted_place))
        assert (ours[0], ours[1], ours[2].tolist()) == (theirs[0], theirs[1], theirs[2].tolist())


def test_heights_of_tags(rng: np.random.Generator) -> None:
    pixels = rng.normal(0.0, 50.0, (6, 8, 2))
    pixels[2, 3] = np.nan
    longer, height = tag_heights(pixels)
    along, down = pixels[::2, 1::2] - pixels[::2, ::2], pixels[1::2, ::2] - pixels[::2, ::2]
    wanted = np.maximum(np.hypot(*np.moveaxis(along, 2, 0)), np.hypot(*np.moveaxis(down, 2, 0)))
    area = np.abs(along[..., 0] * down[..., 1] - along[..., 1] * down[..., 0])
    np.testing.assert_allclose(longer, wanted)
    np.testing.assert_allclose(height, area / wanted)
    assert np.isnan(height).sum() == 1
