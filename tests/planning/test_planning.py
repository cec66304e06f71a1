"""Planning: predicted errors against true ones, poses that a person can hold, advice in words."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from helpers.calibration_scenes import BOARD, REACH_DEG, lens, random_views

from rigkit.calibration.calibrate import calibrate
from rigkit.calibration.solving.shape import WARP_UNKNOWNS, warp_of_board
from rigkit.cameras.base import Camera
from rigkit.cameras.compare import compare_cameras, grid_pixels
from rigkit.cameras.pinhole import Pinhole
from rigkit.core.boards import Board
from rigkit.core.detections import BoardView
from rigkit.core.errors import DegenerateError, InputError
from rigkit.core.reach import Reach
from rigkit.geometry.rigid3 import Rigid3
from rigkit.geometry.rotation import exp_so3
from rigkit.planning.candidates import MAX_SLANT_DEG, TILT_DEG, board_poses_in_view, outline_mm, placement
from rigkit.planning.goal import Goal, projection_goal, px_words, rays_within
from rigkit.planning.information import BoardPoses, CornerError, Knowledge, guessed_camera
from rigkit.planning.plan import choose_views, covariance_of, plan_views

NOISE_PX = 0.2
MONTE_CARLO = 40
PREDICTED_WITHIN = 0.2
"""The rms of 40 errors in some eight directions is known to 6 %; three of that."""


def _seen(camera: Camera, held: BoardPoses, rng: np.random.Generator) -> list[BoardView]:
    points = held.points_mm @ np.swapaxes(held.rotation, 1, 2) + held.translation_mm[:, None]
    pixels, valid = camera.project(points)
    assert valid.all()
    noisy = pixels + NOISE_PX * rng.standard_normal(pixels.shape)
    return [BoardView(f"{k}", BOARD, BOARD.grid(), p, np.full(len(p), NOISE_PX)) for k, p in enumerate(noisy)]


@pytest.mark.parametrize("name", ["reg", "fish"])
def test_the_error_promised_is_the_error_found(name: str, rng: np.random.Generator) -> None:
    camera, field_deg = lens(name), 2.0 * REACH_DEG[name]
    held = board_poses_in_view(camera, BOARD, Reach(field_deg=field_deg))
    held = held.chosen(rng.choice(len(held), 10, replace=False))
    known = Knowledge.guessed(camera, CornerError(NOISE_PX)).with_views(held)
    promised = projection_goal(camera, field_deg).error(covariance_of(known.information))
    rays, seen = camera.unproject(grid_pixels(camera.size_px, (24, 18)))
    seen &= rays[..., 2] >= np.cos(np.radians(REACH_DEG[name]))
    squared = []
    for _ in range(MONTE_CARLO):
        degree = 5 if camera.model == "brown" else None
        found = calibrate(
            _seen(camera, held, rng), camera.size_px, model=camera.model, degree=degree, board="flat", folds=0
        )
        squared.append(compare_cameras(camera, found.camera, grid=(24, 18), mask=seen).rms_px ** 2)
    assert np.sqrt(np.mean(squared)) == pytest.approx(promised, rel=PREDICTED_WITHIN)


def test_a_field_leaves_rays_out_that_the_lens_sees() -> None:
    camera, field_deg = lens("fish"), 2.0 * REACH_DEG["fish"]
    pixels = grid_pixels(camera.size_px, (24, 18)).reshape(-1, 2)
    every = rays_within(camera, pixels, None)
    inside = every[:, 2] >= np.cos(np.radians(0.5 * field_deg))
    assert 0 < inside.sum() < len(every)
    assert np.array_equal(rays_within(camera, pixels, field_deg), every[inside])


def test_a_calibration_is_known_as_its_own_views_say(rng: np.random.Generator) -> None:
    camera = lens("wide")
    views, _, _ = random_views(camera, 12, rng, reach_deg=REACH_DEG["wide"], noise_px=NOISE_PX)
    calibration = calibrate(views, camera.size_px, model=camera.model, board="flat")
    known, goal = Knowledge.of(calibration), projection_goal(calibration.camera)
    # The clustered covariance has a shape of its own; its size is the same.
    stated, own = goal.error(calibration.covariance), goal.error(covariance_of(known.information))
    assert own == pytest.approx(float(stated), rel=0.5)
    (shape,) = calibration.boards
    board = shape.board
    assert board.size == BOARD.size
    assert board.square_x_mm == pytest.approx(30.0) and board.square_y_mm == pytest.approx(30.0)


def test_views_that_share_their_errors_count_less() -> None:
    camera = lens("reg")
    held = board_poses_in_view(camera, BOARD, Reach()).chosen(np.arange(5))
    alone = Knowledge.guessed(camera, CornerError(0.2)).with_views(held)
    shared = Knowledge.guessed(camera, CornerError(0.2, rho=0.1)).with_views(held)
    goal = projection_goal(camera)
    errors = [float(goal.error(covariance_of(known.information))) for known in (alone, shared)]
    assert errors[1] > 1.5 * errors[0]


@pytest.mark.parametrize("name", ["reg", "wide", "fish"])
def test_boards_are_held_wholly_in_view_and_as_tilted_as_hands_do(name: str) -> None:
    camera, reach = lens(name), Reach(nearest_mm=150.0, farthest_mm=900.0, field_deg=2.0 * REACH_DEG[name])
    held = board_poses_in_view(camera, BOARD, reach)
    assert len(held) > 100
    paper = outline_mm(BOARD)
    points = paper @ np.swapaxes(held.rotation, 1, 2) + held.translation_mm[:, None]
    pixels, valid = camera.project(points)
    assert valid.all() and camera.on_image(pixels).all()
    assert (points[..., 2] >= np.cos(np.radians(REACH_DEG[name])) * np.linalg.norm(points, axis=-1) - 1e-9).all()
    middle = held.rotation @ paper.mean(axis=0) + held.translation_mm
    distance = np.linalg.norm(middle, axis=1)
    assert distance.min() >= 150.0 and distance.max() <= 900.0
    tilt = np.degrees(np.arccos(np.einsum("cx,cx->c", middle / distance[:, None], held.rotation[..., 2])))
    assert TILT_DEG[0] - 1e-6 <= tilt.min() and tilt.max() <= TILT_DEG[1] + 1e-6 < MAX_SLANT_DEG


def test_a_board_too_far_to_be_seen_is_refused() -> None:
    with pytest.raises(DegenerateError, match="nowhere completely in view"):
        board_poses_in_view(lens("reg"), BOARD, Reach(nearest_mm=1e5))


def test_greedy_takes_the_view_that_helps_most_each_once() -> None:
    views = np.stack([np.diag([1.0, 0.0]), np.diag([0.0, 9.0]), np.diag([8.0, 0.0])])
    goal = Goal(np.eye(2), "px", "both")
    taken, errors = choose_views(np.eye(2), views, goal, 5)
    assert taken == [1, 2, 0]
    assert errors == pytest.approx(np.sqrt([1.1, 1 / 9 + 0.1, 1 / 10 + 0.1]))


def test_of_views_as_good_the_nearest_is_taken() -> None:
    views = np.stack([np.diag([8.0, 1.0]), np.diag([8.0, 1.0]), np.diag([0.0, 1.0])])
    taken, _ = choose_views(
        np.eye(2), views, Goal(np.diag([1.0, 0.0]), "px", "one"), 1, effort=lambda last: np.array([3.0, 2.0, 1.0])
    )
    assert taken == [1]


def test_views_that_help_nothing_are_taken_though_rounding_makes_the_error_grow() -> None:
    # Taking information away stands for the rounding: which sign it has depends on the processor.
    views = np.stack([np.diag([-1e-12, 0.0])] * 2)
    taken, _ = choose_views(np.eye(2), views, Goal(np.eye(2), "px", "both"), 1, effort=lambda _: np.array([2.0, 1.0]))
    assert taken in ([0], [1])


def test_views_with_nan_are_refused() -> None:
    views = np.stack([np.diag([8.0, 1.0])] * 2)
    with pytest.raises(DegenerateError, match="no view can be evaluated"):
        choose_views(np.full((2, 2), np.nan), views, Goal(np.eye(2), "px", "one"), 1, effort=lambda _: np.ones(2))


def test_planned_views_beat_views_anyhow(rng: np.random.Generator) -> None:
    camera, error = lens("reg"), CornerError(NOISE_PX)
    known, goal = Knowledge.guessed(camera, error), projection_goal(camera)
    plan = plan_views(known, [BOARD], goal, 6)
    assert [v.error for v in plan.views] == sorted((v.error for v in plan.views), reverse=True)
    unplanned = []
    for _ in range(20):
        _, rotation, translation = random_views(camera, 6, rng, reach_deg=REACH_DEG["reg"])
        seen = np.ones((6, BOARD.corner_count), dtype=bool)
        views = known.with_views(BoardPoses(BOARD.points(), rotation, translation, seen))
        unplanned.append(float(goal.error(covariance_of(views.information))))
    assert plan.views[-1].error < 0.6 * np.median(unplanned)
    with pytest.raises(InputError, match="at least one board"):
        plan_views(known, [], goal, 1)


@pytest.mark.parametrize(("hfov", "model"), [(60.0, "brown"), (90.0, "brown"), (150.0, "kannala_brandt")])
def test_a_guessed_lens_has_the_stated_field_of_view(hfov: float, model: str) -> None:
    camera = guessed_camera(hfov, (1280, 960))
    assert camera.model == model
    (left, right), valid = camera.unproject(np.array([[-0.5, 479.5], [1279.5, 479.5]]))
    assert valid.all()
    assert np.degrees(np.arccos(left @ right)) == pytest.approx(hfov, abs=0.1)


@pytest.mark.parametrize(
    ("at", "turn_deg", "words"),
    [
        ((0.0, 0.0, 400.0), (0.0, 0.0, 0.0), "middle, 40 cm away, facing"),
        ((0.0, 0.0, 400.0), (0.0, 35.0, 0.0), "middle, 40 cm away, tilted 35 degrees, right side nearer"),
        ((0.0, 0.0, 400.0), (0.0, -35.0, 0.0), "middle, 40 cm away, tilted 35 degrees, left side nearer"),
        ((0.0, 0.0, 400.0), (30.0, 0.0, 0.0), "middle, 40 cm away, tilted 30 degrees, upper side nearer"),
        ((0.0, 0.0, 400.0), (-30.0, 0.0, 0.0), "middle, 40 cm away, tilted 30 degrees, lower side nearer"),
        ((0.0, 0.0, 400.0), (0.0, 0.0, 90.0), "middle, 40 cm away, facing, long side vertical"),
        ((0.0, 0.0, 4.4), (0.0, 0.0, 0.0), "middle, 4.4 mm away, facing"),
    ],
)
def test_words(at: tuple[float, ...], turn_deg: tuple[float, ...], words: str) -> None:
    board = Board("b", 9, 6, 20.0, 20.0)
    rotation = exp_so3(np.radians(turn_deg))
    middle = outline_mm(board).mean(axis=0)
    assert str(placement(guessed_camera(60.0, (1280, 960)), board, Rigid3(rotation, at - rotation @ middle))) == words


def test_an_image_error_is_converted_to_mm() -> None:
    # A pixel of a narrow lens is an angle of 1 / f.
    narrow = Pinhole((640, 480), np.array([10000.0, 10000.0, 319.5, 239.5]))
    assert px_words(narrow, 0.5) == "0.5 px, 0.05 mm at 1 m"


def test_words_of_a_corner() -> None:
    where = placement(guessed_camera(90.0, (1280, 960)), BOARD, Rigid3(np.eye(3), [400.0, -400.0, 600.0]))
    assert where.place == "top right corner"


def test_a_board_that_may_bow_is_shown_turned() -> None:
    """Of a board whose aspect is not known, views that are all the same way up leave the ratio of the focal lengths."""
    camera = lens("reg")
    known = Knowledge.guessed(camera, CornerError(0.1))
    p = camera.parameters.size
    warp = warp_of_board(BOARD.points())
    information = np.zeros((p + WARP_UNKNOWNS, p + WARP_UNKNOWNS))
    information[:p, :p], information[p:, p:] = known.information, np.diag(warp.sigma**-2)
    unsure = replace(known, information=information, warped=(BOARD.board_id,))
    held = board_poses_in_view(camera, BOARD, Reach())
    level = np.abs(held.rotation[:, 0, 0]) > np.abs(held.rotation[:, 1, 0])
    half = 6
    same = held.chosen(np.flatnonzero(level)[: 2 * half])
    turned = held.chosen(np.concatenate([np.flatnonzero(level)[:half], np.flatnonzero(~level)[:half]]))
    ratio = np.zeros(p)
    ratio[:2] = 1.0, -1.0

    def unknown(knowledge: Knowledge, views: BoardPoses) -> float:
        covariance = covariance_of(knowledge.with_views(views, BOARD.board_id).information)[:p, :p]
        return float(np.sqrt(ratio @ covariance @ ratio))

    flat_gain, warp_gain = (unknown(k, same) / unknown(k, turned) for k in (known, unsure))
    assert warp_gain > 2.0 * flat_gain
    assert unknown(unsure, turned) > unknown(known, turned)


def test_boards_are_pushed_until_they_are_in_the_image(monkeypatch: pytest.MonkeyPatch) -> None:
    """A push brings most of them in, and further ones those that the first left half outside (1576, 1851 poses)."""
    monkeypatch.setattr("rigkit.planning.candidates.CANDIDATES_KEPT", 9999)
    camera, board = Pinhole((640, 480), np.array([545.0, 545.0, 318.0, 242.0])), Board("a", 9, 6, 25.0, 25.0)
    counts = []
    for moves in (1, 5):
        monkeypatch.setattr("rigkit.planning.candidates.MOVES", moves)
        counts.append(len(board_poses_in_view(camera, board, Reach())))
    assert counts[1] > 1.1 * counts[0]
