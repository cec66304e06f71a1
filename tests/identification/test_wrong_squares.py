"""The true square size of a board that was declared with another one."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from helpers.board_scenes import both_views, fisheye_camera, lab_scene, regular_camera, trihedral_scene

from rigkit.cameras.base import Camera
from rigkit.core.boards import Board
from rigkit.core.detections import BoardDetection
from rigkit.identification.identify import identify_pair
from rigkit.identification.wrong_squares import fitting_squares

FACTOR_REL = 2e-3
"""48 corners with noise of 0.05 px, seen from a pose that 96 others give: a size comes out to 1e-4 or so."""
EQUAL = tuple(Board(i, 8, 6, 50.0, 50.0) for i in "abc")
DIFFERENT = tuple(Board(i, columns, 6, 50.0, 50.0) for i, columns in zip("abc", (9, 8, 7), strict=True))


def declared(boards: tuple[Board, ...], wrong: int, square_mm: float) -> list[Board]:
    """The boards with squares of one written wrongly."""
    out = list(boards)
    out[wrong] = replace(boards[wrong], square_x_mm=square_mm, square_y_mm=square_mm)
    return out


@pytest.mark.parametrize("camera", [regular_camera(), fisheye_camera()], ids=["regular", "fisheye"])
@pytest.mark.parametrize("boards", [EQUAL, DIFFERENT], ids=["equal", "different"])
def test_the_board_is_named_with_the_size_that_it_has(
    boards: tuple[Board, ...], camera: Camera, rng: np.random.Generator
) -> None:
    for wrong, square_mm in enumerate((43.0, 45.0, 60.0)):
        scene = trihedral_scene(rng, boards, camera)
        one, two = both_views(scene, rng)
        as_declared = declared(boards, wrong, square_mm)
        assert identify_pair(one, two, as_declared, camera, camera).missing
        (found,) = fitting_squares(one, two, as_declared, camera, camera)
        assert found.boards == (as_declared[wrong],)
        assert found.factor == pytest.approx(50.0 / square_mm, rel=FACTOR_REL)


@pytest.mark.real
@pytest.mark.parametrize("name", ["regular-general", "fisheye-general"])
def test_two_boards_that_fit_in_several_ways_are_told_by_the_third(name: str, rng: np.random.Generator) -> None:
    """The laboratory's boards stand so that any two of them look like any other two."""
    scene = lab_scene(name)
    one, two = both_views(scene, rng)
    (found,) = fitting_squares(one, two, declared(scene.boards, 1, 45.0), scene.camera1, scene.camera2)
    assert [board.board_id for board in found.boards] == ["plane2"]
    assert found.factor == pytest.approx(50.0 / 45.0, rel=FACTOR_REL)


def test_of_boards_declared_alike_the_odd_one_is_shown(rng: np.random.Generator) -> None:
    real = declared(EQUAL, 1, 42.0)
    scene = trihedral_scene(rng, tuple(real), regular_camera())
    one, two = both_views(scene, rng)
    (found,) = fitting_squares(one, two, EQUAL, scene.camera1, scene.camera2)
    u, v = scene.pixels1["b"].mean(axis=0)
    assert found.boards == EQUAL and found.where == f"the 8x6 grid round ({u:.0f}, {v:.0f})"
    assert found.factor == pytest.approx(42.0 / 50.0, rel=FACTOR_REL)


def test_of_two_boards_either_may_be_wrong(rng: np.random.Generator) -> None:
    scene = trihedral_scene(rng, DIFFERENT[:2], regular_camera())
    one, two = both_views(scene, rng)
    found = fitting_squares(one, two, declared(DIFFERENT[:2], 0, 40.0), scene.camera1, scene.camera2)
    assert [(one.boards[0].board_id, round(one.factor, 2)) for one in found] == [("a", 1.25), ("b", 0.8)]


def test_nothing_is_said_of_boards_that_fit_are_covered_or_moved(rng: np.random.Generator) -> None:
    scene = trihedral_scene(rng, EQUAL, regular_camera())
    one, two = both_views(scene, rng)

    def printed(first: list[BoardDetection], second: list[BoardDetection]) -> int:
        return len(fitting_squares(first, second, EQUAL, scene.camera1, scene.camera2))

    assert printed(one, two) == printed(one[:2], two) == printed(one[:1], two) == 0
    moved = replace(two[0], pixels=two[0].pixels @ np.array([[0.9, 0.2], [-0.2, 0.9]]) + [90.0, -60.0])
    assert printed(one, [moved, *two[1:]]) == 0
