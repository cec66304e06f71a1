"""Circles in large images: large ones are found in a smaller image, small ones in a second search."""

from __future__ import annotations

import numpy as np
import pytest
from detection_bench.scenes import BenchScene, one_board

from rigkit.core.arrays import FloatArray
from rigkit.core.boards import Board
from rigkit.core.detections import BoardDetection
from rigkit.core.patterns.circles import Circles
from rigkit.detection.circles.blobs import Blobs, find_blobs
from rigkit.detection.detect import detect_boards
from rigkit.detection.saddles.response import GreyImage

SIZE_PX = (1600, 1200)
ACCURATE_PX = 0.012
"""Bound of the RMS error of a centre: it is 0.003 px for circles of 40 px, and 0.009 px for those of 6 px."""
HONEST = (0.6, 1.4)


def looks_coarse(monkeypatch: pytest.MonkeyPatch) -> list[bool]:
    """Return a list to which each search for blobs appends whether it is a coarse one."""
    said: list[bool] = []

    def search(grey: GreyImage, *, coarse: bool, known: Blobs | None) -> Blobs:
        said.append(coarse)
        return find_blobs(grey, coarse=coarse, known=known)

    monkeypatch.setattr("rigkit.detection.circles.search.find_blobs", search)
    return said


def errors(found: BoardDetection, scene: BenchScene) -> FloatArray:
    """Return the errors (N, 2) of the centres of the only board, px."""
    truth = scene.truth()[0].pixels
    return np.asarray(found.pixels - truth[np.linalg.norm(found.pixels[:, None] - truth, axis=2).argmin(axis=1)])


@pytest.mark.parametrize("square_px", [66.0, 10.0])
def test_circles_of_any_size_are_found_whole_and_accurately(monkeypatch: pytest.MonkeyPatch, square_px: float) -> None:
    """The search of a quarter of the pixels has all circles of 40 px; those of 6 px need the other."""
    board = Board("b", 10, 8, 25.0, 25.0, pattern=Circles(diameter_mm=15.0))
    rng = np.random.default_rng(3)
    scene = one_board(rng, board=board, size_px=SIZE_PX, square_px=square_px, max_tilt_deg=20.0)
    image = scene.render(noise_levels=2.0, rng=rng, supersample=3)
    coarse = looks_coarse(monkeypatch)
    (found,) = detect_boards(image, [board])
    assert found.board_id == "b" and found.complete
    assert coarse == ([True] if square_px > 20.0 else [True, False])
    off = errors(found, scene)
    assert np.sqrt((off**2).sum(axis=1).mean()) < ACCURATE_PX
    assert HONEST[0] < np.sqrt(((off / found.sigma_px[:, None]) ** 2).mean()) < HONEST[1]


@pytest.mark.parametrize("quick", [False, True])
def test_a_board_that_is_named_in_a_smaller_image_is_not_searched_for_again(
    monkeypatch: pytest.MonkeyPatch, quick: bool
) -> None:
    board = Board("b", 10, 8, 25.0, 25.0, pattern=Circles(diameter_mm=15.0))
    scene = one_board(np.random.default_rng(3), board=board, size_px=SIZE_PX, square_px=66.0)
    image = np.asarray(scene.render(supersample=2)).copy()
    u, v = np.rint(scene.truth()[0].pixels[37]).astype(int)
    image[v - 25 : v + 25, u - 25 : u + 25] = 128
    coarse = looks_coarse(monkeypatch)
    (found,) = detect_boards(image, [board], quick=quick)
    # The square hides one circle whole.
    assert coarse == [True] and found.board_id == "b" and len(found.grid) >= 78


def test_large_circles_with_much_blur_are_found() -> None:
    """Their sizes from the reduced image need two fits in the image itself."""
    board = Board("b", 10, 8, 25.0, 25.0, pattern=Circles(diameter_mm=21.0))
    rng = np.random.default_rng(101)
    scene = one_board(rng, board=board, size_px=(1280, 960), square_px=40.0 / 0.84, max_tilt_deg=35.0)
    image = scene.render(blur_px=6.0, noise_levels=2.0, rng=np.random.default_rng(1), supersample=1)
    (found,) = detect_boards(image, [board])
    assert found.complete


def test_sigmas_of_circles_first_found_in_a_much_smaller_image_are_those_of_the_image_itself() -> None:
    """Circles of 90 px are first found in an image of a sixteenth of the pixels."""
    board = Board("b", 8, 6, 25.0, 25.0, pattern=Circles(diameter_mm=15.0))
    rng = np.random.default_rng(4)
    scene = one_board(rng, board=board, size_px=SIZE_PX, square_px=150.0, max_tilt_deg=20.0)
    (found,) = detect_boards(scene.render(noise_levels=2.0, rng=rng, supersample=3), [board])
    assert HONEST[0] < np.sqrt(((errors(found, scene) / found.sigma_px[:, None]) ** 2).mean()) < HONEST[1]
