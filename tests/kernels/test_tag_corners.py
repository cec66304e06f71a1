"""The fit of the corners of tags: every call that finding AprilGrids makes, against its definition in numpy."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from detection_bench.scenes import one_board
from helpers.data import read_grey, shared_data
from kernels.reference import edges as reference

from rigkit.core.boards import Board
from rigkit.core.patterns.aprilgrid import AprilGrid
from rigkit.detection.detect import detect_boards
from rigkit.detection.subpixel.edge_fit import edge_rules
from rigkit.detection.subpixel.subpixel import LAST_PASS
from rigkit.detection.tags import corners
from rigkit.kernels.edges import blur_of_tags, fit_corners, fit_tag_corners

KALIBR = Board("k", 10, 8, 60.0, 60.0, pattern=AprilGrid(0.3))
ALONE = Board("k", 10, 8, 60.0, 60.0, pattern=AprilGrid(0.3, corner_squares=False))


def compared(image: np.ndarray, board: Board, monkeypatch: pytest.MonkeyPatch) -> int:
    """Return how many corners were fitted, all of which the kernel fits as `fit_corners` does with the geometry that
    numpy makes, and the blur of some as the median of theirs."""
    monkeypatch.setattr(reference, "fit_corners", fit_corners)
    fitted = 0

    def fit(*arguments: Any) -> np.ndarray:
        nonlocal fitted
        ours, theirs = fit_tag_corners(*arguments), reference.fit_tag_corners(*arguments)
        fitted += len(ours)
        # What comes out of windows that hold nothing is none.
        np.testing.assert_allclose(ours, theirs, rtol=1e-6, atol=1e-9, equal_nan=True)
        return ours

    def blur(*arguments: Any) -> float:
        one, two = blur_of_tags(*arguments), reference.blur_of_tags(*arguments)
        assert one == pytest.approx(two, rel=1e-9, nan_ok=True)
        return one

    monkeypatch.setattr(corners, "fit_tag_corners", fit)
    monkeypatch.setattr(corners, "blur_of_tags", blur)
    assert len(detect_boards(image, [board])) == 1
    return fitted


@pytest.mark.parametrize("lens", ["regular", "fisheye"])
@pytest.mark.parametrize("board", [KALIBR, ALONE], ids=["kalibr", "tags alone"])
def test_corners_of_rendered_boards(
    board: Board, lens: str, rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch
) -> None:
    scene = one_board(rng, lens=lens, board=board)
    assert compared(scene.render(noise_levels=2.0, rng=rng), scene.boards[0].board, monkeypatch) >= 80


def test_corners_of_photographs(monkeypatch: pytest.MonkeyPatch) -> None:
    folder: Path = shared_data("public/aprilgrid-mocap/cam0/data")
    board = Board("m", 12, 12, 88.0, 88.0, pattern=AprilGrid(0.3))
    for path in sorted(folder.glob("*.jpg"))[::10]:
        assert compared(read_grey(path), board, monkeypatch) >= 100


def test_corners_that_no_cell_has_are_refused() -> None:
    none = np.zeros((3, 2))
    with pytest.raises(ValueError, match="3 corners of tags for 2 cells"):
        fit_tag_corners(
            *(np.zeros((20, 20), np.uint8), np.array([[True, True]]), np.zeros((1, 2, 2, 2)), np.ones((1, 2)), none),
            *(np.zeros((3, 15)), none, none[:, 0], none[:, 0], corners._window(0.1)),
            edge_rules(*LAST_PASS, False, True),
        )
