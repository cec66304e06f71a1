"""Findings about boards and about deviating images: right, and reported once."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from helpers.calibration_scenes import SIZE, lens, random_views
from helpers.session_scenes import poses, seen

from rigkit.calibration.board_shape import BoardShape
from rigkit.calibration.calibrate import calibrate
from rigkit.calibration.diagnosis.boards import _spacing, _unseen_rows
from rigkit.calibration.result import Calibration, ViewResult
from rigkit.core.boards import Board
from rigkit.core.findings import Severity, worst
from rigkit.core.patterns.aprilgrid import AprilGrid
from rigkit.geometry.rigid3 import Rigid3


def printed(result: Calibration, text: str) -> bool:
    return any(text in finding.message for finding in result.verdicts)


@pytest.mark.parametrize("declared", [0.25, 0.3])
def test_tags_nearer_than_declared_are_told(declared: float, rng: np.random.Generator) -> None:
    board = Board("tags", 8, 8, 40.0, 40.0, pattern=AprilGrid(declared))
    true = replace(board, pattern=AprilGrid(0.3)).points()
    views, _, _ = random_views(lens("reg"), 15, rng, reach_deg=33.0, board=board, points_mm=true, noise_px=0.05)
    result = calibrate(views, SIZE, model="brown")
    assert printed(result, "has spacing = 0.30, 0.25 is declared") == (declared == 0.25)
    assert printed(result, "has spacing =") == (declared == 0.25)


@pytest.mark.parametrize(("own", "count", "told"), [(4, 9, True), (8, 9, False), (4, 2, False)])
def test_rows_that_no_image_shows_are_told(own: int, count: int, told: bool, rng: np.random.Generator) -> None:
    """Of Kalibr's boards the last tags are in the first rows; `count` images would show them."""
    board = Board("tags", 8, 8, 40.0, 40.0, pattern=AprilGrid(0.3))
    views, rotations, translations = random_views(lens("reg"), 9, rng, reach_deg=33.0, board=board, noise_px=0.05)
    results = []
    for view, rotation, translation in zip(views, rotations, translations, strict=True):
        kept = view.grid[:, 1] >= 8 - own
        results.append(
            ViewResult(
                image=view.image,
                board_id="tags",
                cam_from_board=Rigid3(rotation, translation),
                grid=view.grid[kept],
                pixels=view.pixels[kept],
                residuals_px=np.zeros((own * 8, 2)),
                kept=np.ones(own * 8, bool),
            )
        )
    shape = BoardShape("tags", "flat", board.points(), declared=board)
    found = list(_unseen_rows("board 'tags'", shape, lens("reg"), results[:count]))
    assert bool(found) == told
    if told:
        assert found[0].message == (
            "board 'tags' is seen as 4 x 2 tags in 9 images, 4 x 4 tags are declared: 9 images would show the others"
        )


def test_one_tag_has_no_gap() -> None:
    board = Board("tag", 2, 2, 40.0, 40.0, pattern=AprilGrid(0.3))
    assert list(_spacing("tag", BoardShape("tag", "released", board.points(), declared=board))) == []


def test_an_unsure_lens_tells_nothing_of_how_long_squares_are(rng: np.random.Generator) -> None:
    """Boards that are the same way up, and a zoom that changed: squares seem longer by per cent, and none is."""
    upright = np.array([1.0, 1.0, 0.05]) * 0.3 * rng.normal(size=(24, 3))
    views, middle = seen(lens("reg"), *poses(rng, 24, upright), rng), 0.5 * (np.array(SIZE) - 1.0)
    zoomed = [replace(v, pixels=(v.pixels - middle) / (1.15 if k < 8 else 1.0) + middle) for k, v in enumerate(views)]
    result = calibrate(zoomed, SIZE, model="brown", board="warp")
    assert worst(result.verdicts) is Severity.BAD
    assert abs(result.boards[0].aspect) > 2e-3 and not printed(result, "than declared")


def test_outliers_of_an_image_that_is_named_are_not_told_again(rng: np.random.Generator) -> None:
    views, _, _ = random_views(lens("reg"), 8, rng, reach_deg=33.0, noise_px=0.05)
    moved = views[4].pixels.copy()
    moved[rng.permutation(54)[:16]] += rng.choice([-1.0, 1.0], size=(16, 2))
    result = calibrate([*views[:4], replace(views[4], pixels=moved), *views[5:]], SIZE, model="brown", board="flat")
    assert len(result.outliers) > 0.03 * (result.corner_count + len(result.outliers))
    assert printed(result, "image '004.png' has 16 outliers") and not printed(result, "of the corners are outliers")
