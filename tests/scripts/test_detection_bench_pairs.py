"""Pairs of identical boards: their promised properties, and the judgement of right and wrong identities."""

from __future__ import annotations

import numpy as np
import pytest
from detection_bench.pairs import EQUAL_BOARDS, PairVerdict, equal_boards_pair, evaluate_pair


@pytest.mark.parametrize("seed", [0, 1, 2, 3, 9, 19])
def test_pairs_see_three_equal_boards_whole(seed: int) -> None:
    what, scene = equal_boards_pair(seed)
    assert what.split(",")[0] == ("regular", "fisheye")[(seed + seed // 10) % 2]
    assert {(b.board.size, b.board.square_x_mm) for b in scene.boards} == {((8, 6), 40.0)}
    assert all(d.complete for view in scene.detections() for d in view)
    # The walls are perpendicular, and no paper runs through another wall.
    normals = scene.normals_in_cam1()
    np.testing.assert_allclose(normals @ normals.T, np.eye(3), atol=1e-9)
    for board in scene.boards:
        assert (board.outline() < 1e-6).all()
    again = equal_boards_pair(seed)[1]
    assert again.cam2_from_cam1.allclose(scene.cam2_from_cam1)


def test_every_tenth_pair_is_symmetric() -> None:
    """A third of a turn takes every corner of an exactly symmetric pair to one of another board."""
    what, scene = equal_boards_pair(9)
    assert "0 mm" in what
    points = [b.points() for b in scene.boards]
    turned = [p[:, [2, 0, 1]] for p in points]
    for k in range(3):
        nearest = np.linalg.norm(turned[k][:, None] - points[(k + 1) % 3], axis=2).min(axis=1)
        np.testing.assert_allclose(nearest, 0.0, atol=1e-9)


def test_verdicts() -> None:
    _, scene = equal_boards_pair(2)
    one, two = scene.detections()
    pairs = list(zip(one, two, strict=True))
    assert evaluate_pair(scene, pairs, False) == PairVerdict.RIGHT
    # Both turned alike, and under other names, is as right.
    alike = [(a.turned(2).named("x"), b.turned(2).named("x")) for a, b in pairs]
    assert evaluate_pair(scene, alike, False) == PairVerdict.RIGHT
    turned = [*pairs[:2], (one[2], two[2].turned(2))]
    assert evaluate_pair(scene, turned, False) == PairVerdict.WRONG
    assert evaluate_pair(scene, turned, True) == PairVerdict.AMBIGUOUS
    swapped = [(one[0], two[1]), (one[1], two[0]), pairs[2]]
    assert evaluate_pair(scene, swapped, False) == PairVerdict.WRONG
    assert evaluate_pair(scene, pairs[:2], False) == PairVerdict.INCOMPLETE
    assert all(board.looks_same_turned for board in EQUAL_BOARDS)
