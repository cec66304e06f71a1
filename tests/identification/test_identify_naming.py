"""Names and first corners of equal boards: by rule, or by a layout."""

from __future__ import annotations

import numpy as np
import pytest
from helpers.board_scenes import both_views, fisheye_camera, trihedral_scene

from rigkit.core.boards import Board
from rigkit.core.detections import BoardDetection
from rigkit.core.errors import InputError
from rigkit.geometry.rotation import exp_so3
from rigkit.identification.board_ids import LocatedBoard, assign_board_ids, first_corner_turn
from rigkit.identification.identify import identify_pair
from rigkit.identification.placements import Placement, board_kinds

EQUAL = tuple(Board(i, 8, 6, 50.0, 50.0) for i in ("one", "two", "three"))
FACES = {
    "left": (1.0, 0.0, 0.0),
    "right": (-1.0, 0.0, 0.0),
    "floor": (0.0, -1.0, 0.0),
    "ceiling": (0.0, 1.0, 0.0),
    "back": (0.0, 0.0, -1.0),
}
PLACES = {"left": (-600, 0, 1500), "right": (600, 0, 1500), "floor": (0, 500, 1500), "ceiling": (0, -500, 1500)}


def hanging(side: str, kind: int = 0, upright: bool = False, turn_rad: float = 0.0) -> LocatedBoard:
    """A board in the middle of a side of a room that camera 1 looks into; the whole room turned about the view."""
    into = -np.array(FACES[side])
    level = np.array([0.0, 0.0, 1.0]) if abs(into[2]) < 0.5 else np.array([1.0, 0.0, 0.0])
    x = level if not upright else np.cross(into, level)
    out = np.eye(4)
    out[:3, :3] = np.stack([x, np.cross(into, x), into], axis=1)
    out[:3, 3] = np.array(PLACES.get(side, (0, 0, 2000))) - out[:3, :3] @ EQUAL[0].points().mean(axis=0)
    room = np.eye(4)
    room[:3, :3] = exp_so3(np.array([0.0, 0.0, turn_rad]))
    return LocatedBoard(kind, room @ out)


@pytest.mark.parametrize("turn_deg", [0.0, 25.0, -25.0])
@pytest.mark.parametrize("order", [("right", "floor", "left"), ("left", "right", "floor")])
def test_clockwise_from_opposite_the_floor(order: tuple[str, ...], turn_deg: float) -> None:
    """Right wall, floor, left wall, in whatever order they were found, and with the camera rolled."""
    seen = [hanging(side, turn_rad=np.radians(turn_deg)) for side in order]
    names, notes = assign_board_ids(seen, board_kinds(EQUAL))
    assert dict(zip(order, names, strict=True)) == {"right": "one", "floor": "two", "left": "three"}
    assert notes == ()


def test_clockwise_from_opposite_the_ceiling() -> None:
    names, _ = assign_board_ids([hanging(s) for s in ("right", "ceiling", "left")], board_kinds(EQUAL))
    assert names == ["three", "two", "one"]


def test_layout_overrides_the_rule() -> None:
    order = ("right", "floor", "left")
    layout = {"one": "left", "two": "floor", "three": "right"}
    names, _ = assign_board_ids([hanging(s) for s in order], board_kinds(EQUAL), layout)
    assert names == ["three", "two", "one"]
    names, _ = assign_board_ids([hanging(s) for s in order], board_kinds(EQUAL), {"one": "floor"})
    assert names[1] == "one" and sorted(names) == ["one", "three", "two"]


def test_two_of_three_boards_are_named_by_their_sides_with_a_note() -> None:
    names, notes = assign_board_ids([hanging("left"), hanging("floor")], board_kinds(EQUAL))
    assert names == ["three", "two"]
    assert "layout" in notes[0]


def test_a_board_listed_upright_is_one_seen_upright() -> None:
    boards = (Board("lying", 8, 6, 50.0, 50.0), Board("standing", 6, 8, 50.0, 50.0))
    (kind,) = board_kinds(boards)
    for upright_side, lying_side in (("left", "right"), ("right", "left")):
        seen = [hanging(upright_side, upright=True), hanging(lying_side)]
        assert assign_board_ids(seen, (kind,))[0] == ["standing", "lying"]


def test_kinds_and_names_of_different_boards() -> None:
    boards = (*EQUAL[:1], Board("small", 8, 6, 30.0, 30.0), Board("other", 7, 6, 50.0, 50.0), EQUAL[1])
    kinds = board_kinds(boards)
    assert [k.ids for k in kinds] == [("one", "two"), ("small",), ("other",)]
    names, _ = assign_board_ids([hanging("left", 1), hanging("right", 2), hanging("floor", 0)], kinds)
    assert names[:2] == ["small", "other"] and names[2] == "one"


def test_bad_layout() -> None:
    kinds = board_kinds(EQUAL)
    with pytest.raises(InputError, match="no board is called 'four'"):
        assign_board_ids([hanging("left")], kinds, {"four": "left"})
    with pytest.raises(InputError, match="side 'north'"):
        assign_board_ids([hanging("left")], kinds, {"one": "north"})


def test_first_corner_is_the_one_nearest_to_the_other_boards() -> None:
    (kind,) = board_kinds(EQUAL[:1])
    item = hanging("back")
    corners = {0: np.array([0, 0]), 2: np.array([7, 5])}
    for turn, corner in corners.items():
        other = item.cam1_from_board[:3, :2] @ (corner * 50.0) + item.cam1_from_board[:3, 3]
        assert first_corner_turn(item, kind, EQUAL[0], [other]) == turn
    # Alone: columns to the right.
    assert first_corner_turn(item, kind, EQUAL[0], []) == (0 if item.cam1_from_board[0, 0] > 0 else 2)
    # The colours have settled an odd + even board.
    odd = Board("odd", 9, 6, 50.0, 50.0)
    (kind,) = board_kinds([odd])
    assert first_corner_turn(item, kind, odd, [np.array([1e4, 0.0, 0.0])]) == 0


def test_layout_through_the_pair(rng: np.random.Generator) -> None:
    scene = trihedral_scene(rng, EQUAL, fisheye_camera())
    one, two = both_views(scene, rng)
    plain = identify_pair(one, two, EQUAL, scene.camera1, scene.camera2)
    layout = {"one": "left", "two": "right", "three": "floor"}
    asked = identify_pair(one, two, EQUAL, scene.camera1, scene.camera2, layout=layout)
    assert [plain.detections1[k].board_id for k in range(3)] == ["one", "two", "three"]
    by_place = {tuple(d.pixels.mean(axis=0).round(6)): d.board_id for d in plain.detections1}
    swapped = {d.board_id: by_place[tuple(d.pixels.mean(axis=0).round(6))] for d in asked.detections1}
    assert swapped == {"one": "three", "two": "one", "three": "two"}


def test_placement_moves_grid_and_frame_alike(rng: np.random.Generator) -> None:
    """Points of a placed detection, in the board's frame, are those of its own grid moved rigidly."""
    board = Board("b", 8, 6, 50.0, 50.0)
    grid = rng.permutation(np.stack(np.meshgrid(np.arange(4), np.arange(5)), axis=-1).reshape(-1, 2))
    found = BoardDetection(None, 4, 5, grid, rng.normal(size=(20, 2)), np.ones(20))
    for turn in range(4):
        placement = Placement(turn, 2, 1)
        motion = placement.board_from_grid(found, board)
        own = np.column_stack([grid * 50.0, np.zeros(20)])
        moved = own @ motion[:3, :3].T + motion[:3, 3]
        assert np.allclose(moved, board.points(placement.grid_of(found)))
        assert np.linalg.det(motion[:3, :3]) == pytest.approx(1.0)
        placed = placement.apply(found, board)
        order = np.lexsort((placement.grid_of(found)[:, 0], placement.grid_of(found)[:, 1]))
        assert np.array_equal(placed.grid, placement.grid_of(found)[order])
        assert np.array_equal(placed.pixels, found.pixels[order])
