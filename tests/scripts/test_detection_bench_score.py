"""Scores of detectors count every kind of mistake."""

from __future__ import annotations

import numpy as np
import pytest
from detection_bench.scenes import covered_board, empty, one_board, room
from detection_bench.score import FoundBoard, Score, score

from rigkit.core.boards import Board


def perfect(scene: object, sigma_px: float = 0.1) -> list[FoundBoard]:
    truth = scene.truth()  # type: ignore[attr-defined]
    return [FoundBoard(t.pixels, t.grid, np.full(len(t.grid), sigma_px)) for t in truth]


def test_a_perfect_answer_is_perfect_in_any_order_and_orientation(rng: np.random.Generator) -> None:
    scene = room(rng, count=7)
    found = [FoundBoard.of(t.turned(int(rng.integers(4)))) for t in scene.truth()]
    result = score(scene, [found[k] for k in rng.permutation(7)])
    assert (result.recall, result.complete, result.boards) == (1.0, 7, 7)
    assert (result.split, result.false_boards, result.wrong_indices) == (0, 0, 0)
    assert result.rms_px == 0.0
    assert len(result.errors_px) == result.corners


def test_errors_and_sigmas(rng: np.random.Generator) -> None:
    scene = one_board(rng)
    (exact,) = perfect(scene)
    results = []
    for _ in range(20):
        noise = 0.1 * rng.standard_normal(exact.pixels.shape)
        results.append(score(scene, [FoundBoard(exact.pixels + noise, exact.grid, exact.sigma_px)]))
    total = Score.sum(results)
    # 4000 normal variables: their rms is known to 1.1 per cent.
    assert total.rms_px == pytest.approx(0.1 * np.sqrt(2.0), rel=0.05)
    assert total.actual_over_predicted == pytest.approx(1.0, rel=0.05)
    assert (total.boards, total.complete, total.corners) == (20, 20, 2000)


def test_mistakes(rng: np.random.Generator) -> None:
    scene = one_board(rng, board=Board("b", 8, 6, 30.0, 30.0))
    (exact,) = perfect(scene)
    grid = exact.grid
    assert grid is not None

    def of(keep: np.ndarray, **other: np.ndarray) -> FoundBoard:
        return FoundBoard(other.get("pixels", exact.pixels)[keep], other.get("grid", grid)[keep])

    every = np.ones(48, bool)
    # One row in the wrong place: shifted by a column, and the corner that then has no place left out.
    shifted = grid.copy()
    shifted[grid[:, 1] == 5, 0] += 1
    result = score(scene, [of(every, grid=shifted)])
    assert (result.wrong_indices, result.found, result.complete) == (8, 40, 0)
    # Mirrored: no rotation explains more than a line of it.
    mirrored = grid * [1, -1]
    assert score(scene, [of(every, grid=mirrored)]).wrong_indices >= 40
    # Two halves.
    left = grid[:, 0] < 4
    halves = score(scene, [of(left), of(~left)])
    assert (halves.split, halves.complete, halves.recall, halves.wrong_indices) == (1, 0, 1.0, 0)
    # Corners that are none, on a board and as a board.
    moved = exact.pixels.copy()
    moved[:3] += 4.0
    spoilt = score(scene, [of(every, pixels=moved), FoundBoard(exact.pixels + 7.0, grid)])
    assert (spoilt.wrong_indices, spoilt.found, spoilt.false_boards) == (3, 45, 1)
    # Points without order are judged by position alone.
    cloud = score(scene, [FoundBoard(exact.pixels[rng.permutation(48)])])
    assert (cloud.recall, cloud.complete, cloud.wrong_indices) == (1.0, 1, 0)
    assert np.isnan(cloud.actual_over_predicted)
    # Nothing is nothing, not zero error.
    nothing = score(scene, [])
    assert nothing.recall == 0.0
    assert np.isnan(nothing.rms_px)


def test_hidden_corners_and_scenes_without_boards(rng: np.random.Generator) -> None:
    scene = covered_board(rng)
    (clear,) = scene.clear()
    assert 40 <= clear.sum() <= 95
    (exact,) = perfect(scene)
    assert exact.grid is not None
    result = score(scene, [FoundBoard(exact.pixels[clear], exact.grid[clear])])
    assert (result.corners, result.found, result.complete) == (int(clear.sum()), int(clear.sum()), 1)
    assert score(empty(rng), [exact]).false_boards == 1
    assert np.isnan(score(empty(rng), []).recall)
