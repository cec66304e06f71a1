"""Copies of one board in a frame are matched between two cameras by their arrangement, or not at all."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import pytest
from helpers.calibration_scenes import lens
from helpers.rig_scenes import Views

from rigkit.calibration.rig.calibrate import calibrate_rig
from rigkit.calibration.rig.views.copies import with_copies_matched
from rigkit.calibration.rig.views.frames import mounts_of
from rigkit.calibration.rig.views.observations import FrameObservations, Observation, RigViews
from rigkit.core.boards import Board
from rigkit.core.detections import BoardView
from rigkit.core.errors import InputError
from rigkit.geometry.rigid3 import Rigid3
from rigkit.geometry.rotation import exp_so3

LENS = lens("reg")
RIGHT_FROM_LEFT = Rigid3(exp_so3(np.array([0.01, -0.05, 0.02])), [-100.0, 2.0, 1.0])
ROW, STEP_MM = 5, 160.0


def copy(name: str) -> Board:
    """Return a board that looks the same turned by 180 degrees."""
    return Board(name, 7, 5, 20.0, 20.0)


def scattered(rng: np.random.Generator, count: int) -> list[Rigid3]:
    """Return poses of `count` boards side by side, each tilted and shifted by chance."""
    out = []
    for k in range(count):
        rotation = exp_so3(rng.normal(size=3) * np.array([0.3, 0.3, 0.4]))
        aside = STEP_MM * (k - 0.5 * (count - 1)) + rng.uniform(-20, 20)
        place = np.array([aside, rng.uniform(-40, 40), 600.0 + rng.uniform(-40, 40)])
        out.append(Rigid3(rotation, place - rotation @ copy("a").points().mean(axis=0)))
    return out


def observation(board: Board, frame: str, cam_from_board: Rigid3) -> Observation:
    pixels, _ = LENS.project(cam_from_board.apply(board.points()))
    view = BoardView(f"{frame}.png", board, board.grid(), pixels, np.full(len(pixels), 0.05))
    seen = np.ones(len(pixels), dtype=bool)
    return Observation(view, seen, cam_from_board, np.zeros(len(pixels)), frame, (frame, board.board_id))


def observations(frames: Sequence[Mapping[str, Rigid3]]) -> FrameObservations:
    """Return the observations of a camera: in each frame copies by name, with cam_from_board."""
    each = (observation(copy(name), f"{f}", pose) for f, own in enumerate(frames) for name, pose in own.items())
    return {entry.key: entry for entry in each}


def matched(left: FrameObservations, right: FrameObservations) -> RigViews:
    return with_copies_matched(RigViews(["left", "right"], [left, right], (), {}))


def shared(views: RigViews) -> list[tuple[str, str]]:
    """Return the images' names of the boards that share a pose, as the tests name them."""
    left, right = ({e.key: e for e in own.values()} for own in views.seen)
    return sorted(left.keys() & right.keys())


def in_right(poses: Sequence[Rigid3]) -> list[Rigid3]:
    return [RIGHT_FROM_LEFT @ pose for pose in poses]


def named(poses: Sequence[Rigid3], suffix: str) -> dict[str, Rigid3]:
    return {f"copy{k} {suffix}": pose for k, pose in enumerate(poses)}


def test_copies_are_matched_in_any_order_and_orientation(rng: np.random.Generator) -> None:
    poses = scattered(rng, 4)
    half_turn = Rigid3(np.diag([-1.0, -1.0, 1.0]), [120.0, 80.0, 0.0])
    there = [pose @ half_turn for pose in in_right(poses)]
    views = matched(observations([named(poses, "left")]), observations([{f"right {k}": there[k] for k in (2, 0, 1)}]))
    assert shared(views) == [("0", f"copy{k} left") for k in range(3)]
    assert views.seen[0]["0", "copy3 left"].key == ("0, camera 1 alone", "copy3 left")
    for own in views.seen:
        assert all(place == (entry.frame, entry.board_id) for place, entry in own.items())


def test_one_board_in_each_image_keeps_its_name(rng: np.random.Generator) -> None:
    (pose,) = scattered(rng, 1)
    views = RigViews(["left", "right"], [observations([{"a": p}]) for p in (pose, RIGHT_FROM_LEFT @ pose)], (), {})
    assert with_copies_matched(views) is views


def test_a_name_does_not_count_where_another_camera_sees_two_of_them(rng: np.random.Generator) -> None:
    frames = [scattered(rng, 3) for _ in range(3)]
    left = observations([named(own, f"of {f}") for f, own in enumerate(frames)])
    right = observations([{"a": in_right(own)[f]} for f, own in enumerate(frames)])
    assert shared(matched(left, right)) == [("0", "copy0 of 0"), ("1", "copy1 of 1"), ("2", "copy2 of 2")]


def test_a_mount_that_fits_two_boards_only_is_not_believed(rng: np.random.Generator) -> None:
    poses = scattered(rng, 2)
    views = matched(observations([named(poses, "left")]), observations([named(in_right(poses), "right")]))
    assert shared(views) == []
    with pytest.raises(InputError, match=r"'right' shares no board .* leaves open which is which"):
        mounts_of(views)


def test_a_board_with_a_name_that_looks_the_same_turned_settles_a_single_one_of_two(rng: np.random.Generator) -> None:
    poses = scattered(rng, 3)
    left, right = observations([named(poses[:2], "left")]), observations([named(in_right(poses[:1]), "right")])
    for seen, (*_, cam_from_board) in ((left, poses), (right, in_right(poses))):
        own = observation(Board("own", 9, 5, 20.0, 20.0), "0", cam_from_board)
        seen[own.key] = own
    assert len(shared(matched(left, right))) == 2


def row() -> list[Rigid3]:
    return [Rigid3(exp_so3(np.array([0.2, 0.1, 0.3])), [STEP_MM * (k - 2.5), -40.0, 700.0]) for k in range(ROW)]


def test_boards_in_a_row_with_equal_gaps_may_be_the_next_ones() -> None:
    left, right = observations([named(row(), "left")]), observations([named(in_right(row()), "right")])
    assert shared(matched(left, right)) == []


@pytest.mark.parametrize("count", [4, 5])
def test_cameras_that_see_another_end_of_a_row_do_not_share_it(count: int) -> None:
    """A mount that takes each board for the next matches all that both see, the true one all but one."""
    poses = row()[:count]
    left, right = observations([named(poses[1:], "left")]), observations([named(in_right(poses[:-1]), "right")])
    assert shared(matched(left, right)) == []


def test_a_board_with_a_name_of_its_own_settles_the_row(rng: np.random.Generator) -> None:
    left, right = observations([named(row(), "left")]), observations([named(in_right(row()), "right")])
    (pose,) = scattered(rng, 1)
    for seen, cam_from_board in ((left, pose), (right, RIGHT_FROM_LEFT @ pose)):
        own = observation(Board("own", 9, 6, 20.0, 20.0), "0", cam_from_board)
        seen[own.key] = own
    assert len(shared(matched(left, right))) == 1 + ROW


@pytest.mark.parametrize("frames", [1, 2])
def test_a_rig_is_calibrated_from_a_wall_of_copies(frames: int, rng: np.random.Generator) -> None:
    views: Views = {"left": [], "right": []}
    for f in range(frames):
        for k, pose in enumerate(scattered(rng, 6)):
            for name, cam_from_board in (("left", pose), ("right", RIGHT_FROM_LEFT @ pose)):
                board = copy(f"copy{k if name == 'left' else 5 - k} {name} {f}")
                pixels, valid = LENS.project(cam_from_board.apply(board.points()))
                if valid.all() and LENS.on_image(pixels).all():
                    noisy = np.clip(pixels + 0.02 * rng.normal(size=pixels.shape), 0, np.array(LENS.size_px) - 1)
                    view = BoardView(f"{name}{f}.png", board, board.grid(), noisy, np.full(len(noisy), 0.02))
                    views[name].append((f"{f}", view))
    rig = calibrate_rig(views, dict.fromkeys(views, LENS.size_px), model="brown", degree=4, folds=0)
    baseline, sigma = rig.baseline_mm("left", "right")
    truth = float(np.linalg.norm(RIGHT_FROM_LEFT.translation_mm))
    assert abs(baseline - truth) < 3.0 * sigma
    assert sigma < 0.5
