"""Symmetric boards whose corners were counted from different ends: found by the print errors that all views share."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from helpers.calibration_scenes import REACH_DEG, SIZE, lens, projection_difference, random_views

from rigkit.calibration.calibrate import calibrate
from rigkit.calibration.choosing.board_orientation import _improved, board_turn, symmetry_turns, with_boards_renumbered
from rigkit.calibration.result import Calibration
from rigkit.calibration.solving.state import State, evaluate
from rigkit.calibration.views.observations import Observations
from rigkit.core.arrays import BoolArray, FloatArray
from rigkit.core.boards import Board
from rigkit.core.detections import BoardView, grid_turned

OBLONG, SQUARE = Board("8x6", 8, 6, 30.0, 30.0), Board("6x6", 6, 6, 30.0, 30.0)
NOISE_PX = 0.1
PRINT_MM = 0.05


def sheet(kind: str, board: Board, rng: np.random.Generator) -> FloatArray:
    points = board.points()
    away = points - points.mean(axis=0)
    x, y = (2.0 * away / np.maximum(np.ptp(points, axis=0), 1.0))[:, :2].T
    printed = PRINT_MM * rng.normal(size=points.shape)
    if kind == "bow":
        points[:, 2] += 1.0 * (1.0 - x**2) + 0.5 * (1.0 - y**2)
    elif kind == "bumps":
        points += 0.6 * printed
        points[:, 2] += 0.3 * np.sin(2.5 * x + 1.0) * np.cos(3.0 * y + 0.5)
    elif kind == "print":
        points += printed
    elif kind == "print alike from both ends":
        points += 0.5 * (printed + printed[::-1] * [-1.0, -1.0, 1.0])
    return points


def scene(
    kind: str, board: Board, count: int, rng: np.random.Generator, name: str = "reg"
) -> tuple[list[BoardView], BoolArray]:
    """Return views, of which less than half count from another end, and which."""
    points = sheet(kind, board, rng)
    views, _, _ = random_views(
        lens(name), count, rng, reach_deg=REACH_DEG[name], board=board, points_mm=points, noise_px=NOISE_PX
    )
    turned = np.zeros(count, dtype=bool)
    turned[rng.choice(count, 2 * count // 5, replace=False)] = True
    return [other_end(v, 2) if t else v for v, t in zip(views, turned, strict=True)], turned


def other_end(view: BoardView, quarter_turns: int) -> BoardView:
    return replace(view, grid=grid_turned(view.grid, view.board.size, quarter_turns))


def changed(result: Calibration, views: list[BoardView]) -> BoolArray:
    assert len(result.views) == len(views)
    return np.array([(v.grid != w.grid).any() for v, w in zip(result.views, views, strict=True)])


@pytest.mark.parametrize("kind", ["bumps", "print"])
@pytest.mark.parametrize(("name", "model"), [("reg", "brown"), ("fish", "kannala_brandt")])
def test_views_counted_from_the_other_end_are_turned(
    kind: str, name: str, model: str, rng: np.random.Generator
) -> None:
    views, turned = scene(kind, OBLONG, 25, rng, name)
    result = calibrate(views, SIZE, model=model)
    assert result.boards[0].kind == "released"
    # Never a wrong one; of the others, small ones near the rim of a wide lens may tell too little.
    assert not (changed(result, views) & ~turned).any()
    assert changed(result, views).sum() >= (1.0 if name == "reg" else 0.7) * turned.sum()


def test_the_lens_gains_by_it(rng: np.random.Generator) -> None:
    views, turned = scene("bumps", OBLONG, 25, rng)
    right = [other_end(v, 2) if t else v for v, t in zip(views, turned, strict=True)]
    found, best = calibrate(views, SIZE, model="brown"), calibrate(right, SIZE, model="brown")
    assert found.heldout_rms_px == pytest.approx(best.heldout_rms_px, rel=1e-4)
    assert np.abs(projection_difference(found.camera, best.camera, 0.95 * REACH_DEG["reg"])).max() < 1e-3


def test_a_board_without_print_errors_has_no_ends_to_tell(rng: np.random.Generator) -> None:
    views, _ = scene("flat", OBLONG, 8, rng)
    result = calibrate(views, SIZE, model="brown", degree=4, board="released", folds=0, pupil="central")
    assert not changed(result, views).any()


@pytest.mark.parametrize("kind", ["flat", "bow", "print alike from both ends"])
@pytest.mark.parametrize("shape", ["auto", "released"])
def test_what_looks_the_same_from_both_ends_is_left_alone(kind: str, shape: str, rng: np.random.Generator) -> None:
    views, _ = scene(kind, OBLONG, 20, rng)
    assert not changed(calibrate(views, SIZE, model="brown", board=shape), views).any()


@pytest.mark.parametrize("printed_mm", [0.0, 0.03])
def test_a_sheet_that_bends_from_view_to_view_is_told_by_its_print_alone(
    printed_mm: float, rng: np.random.Generator
) -> None:
    """Bends of half a millimetre would drown the print's own errors; they say nothing of the end counted from."""
    printed = printed_mm * rng.normal(size=OBLONG.points().shape)
    x, y = np.linspace(-1.0, 1.0, OBLONG.columns), np.linspace(-1.0, 1.0, OBLONG.rows)[:, None]
    turned = rng.permutation(np.arange(25) % 5 < 2)
    views = []
    for k, other in enumerate(turned.tolist()):
        points = OBLONG.points() + printed
        a, b, c = 0.5 * rng.normal(size=3)
        points[:, 2] += (a * x**2 + b * x * y + c * y**2).ravel()
        (view,), _, _ = random_views(
            lens("reg"), 1, rng, reach_deg=REACH_DEG["reg"], board=OBLONG, points_mm=points, noise_px=NOISE_PX
        )
        views.append(replace(other_end(view, 2) if other else view, image=f"{k:03d}.png"))
    found = changed(calibrate(views, SIZE, model="brown", board="released"), views)
    assert (found == turned).all() if printed_mm else not found.any()


def test_the_worst_sign_is_turned_as_long_as_that_gains() -> None:
    true = np.array([1.0, 1.0, -1.0, 1.0, 1.0, -1.0, 1.0])
    alike = np.outer(true, true) * (1.0 - np.eye(7))
    silent = np.where(np.arange(7) == 2, 0.0, 1.0)
    found = _improved(alike, np.stack([np.ones(7), true, silent]))
    assert np.array_equal(found, [true, true, true * silent])


def test_a_board_with_a_first_corner_is_left_alone(rng: np.random.Generator) -> None:
    board = Board("9x6", 9, 6, 30.0, 30.0)
    views, _ = scene("print", board, 15, rng)
    assert symmetry_turns(board) == (0,)
    assert not changed(calibrate(views, SIZE, model="brown", board="released"), views).any()


def test_quarter_turns_of_a_square_board(rng: np.random.Generator) -> None:
    points = sheet("print", SQUARE, rng)
    views, _, _ = random_views(
        lens("reg"), 24, rng, reach_deg=REACH_DEG["reg"], board=SQUARE, points_mm=points, noise_px=NOISE_PX
    )
    turns = rng.permutation(np.repeat([0, 0, 0, 1, 2, 3], 4))
    counted = [other_end(v, t) for v, t in zip(views, turns.tolist(), strict=True)]
    result = calibrate(counted, SIZE, model="brown", board="released")
    ways = [[other_end(v, t).grid for t in range(4)] for v in views]
    found = np.array(
        [next(t for t in range(4) if (w[t] == r.grid).all()) for w, r in zip(ways, result.views, strict=True)]
    )
    assert (turns != turns[0]).any() and (found == found[0]).all()


@pytest.mark.parametrize(("board", "quarter_turns"), [(OBLONG, 2), (SQUARE, 1), (SQUARE, 3)])
def test_recounting_moves_no_flat_corner(board: Board, quarter_turns: int, rng: np.random.Generator) -> None:
    views, rotation, translation = random_views(lens("reg"), 3, rng, reach_deg=30.0, board=board)
    observations = Observations.from_views(views)
    state = State.start(lens("reg"), rotation, translation, observations)
    again, moved = with_boards_renumbered(observations, state, np.array([True, False, True]), quarter_turns)
    assert (again.views[1].grid == views[1].grid).all() and (again.views[0].grid != views[0].grid).any()
    assert np.allclose(evaluate(moved, again).px, evaluate(state, observations).px, atol=1e-8)
    back = board_turn(board, quarter_turns).apply(board.points())
    place = grid_turned(board.grid(), board.size, quarter_turns)
    assert np.allclose(back[:, :2], place * [board.square_x_mm, board.square_y_mm])


def test_recounting_keeps_the_table_of_boards(rng: np.random.Generator) -> None:
    """Views that were left out may have been the first of their board: the table stays in its old order."""
    views, rotation, translation = zip(
        *(random_views(lens("reg"), 2, rng, reach_deg=30.0, board=board) for board in (OBLONG, SQUARE)), strict=True
    )
    order = [0, 2, 1, 3]
    both = Observations.from_views([(*views[0], *views[1])[i] for i in order]).subset(np.arange(1, 4))
    poses = np.concatenate(rotation)[order[1:]], np.concatenate(translation)[order[1:]]
    state = State.start(lens("reg"), *poses, both)
    again, moved = with_boards_renumbered(both, state, np.array([True, True, False]), 2)
    off = evaluate(moved, again).px - evaluate(state, both).px
    assert np.abs(off[both.present]).max() < 1e-8
