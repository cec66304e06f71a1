"""Rigs whose boards look the same turned, and frames that were not taken at one moment."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from calibration.test_rig import NOISE_PX, SIGMAS, Views, mounts, rig_views, sizes

from rigkit.boards import Board
from rigkit.calibration.rig import RigCalibration, calibrate_rig
from rigkit.calibration.rig_seen import Seen
from rigkit.detections import BoardView
from rigkit.errors import DegenerateError
from rigkit.geometry.rigid3 import Rigid3
from rigkit.geometry.rotation import exp_so3

MODELS = {"reg": "brown", "wide": "kannala_brandt", "fish": "kannala_brandt"}


def assert_true_mounts(rig: RigCalibration) -> None:
    for name in ("wide", "fish"):
        true = mounts()[name][1]
        length, sigma = rig.baseline_mm("reg", name)
        assert abs(length - np.linalg.norm(true.translation_mm)) < SIGMAS * sigma
    assert rig.sigma_px == pytest.approx(NOISE_PX, rel=0.06)


def only_part(view: BoardView, board: Board, turned: bool) -> BoardView:
    """Return the view as one of a smaller board on the same sheet, counted from the other end where `turned`."""
    inside = (view.grid < board.size).all(axis=1)
    grid = np.array(board.size) - 1 - view.grid[inside] if turned else view.grid[inside]
    return BoardView(view.image, board, grid, view.pixels[inside], view.sigma_px[inside])


def test_boards_without_a_first_corner(rng: np.random.Generator) -> None:
    """An 8x6 board looks the same turned by 180 degrees: every image counts from either end."""
    board = Board("8x6", 8, 6, 30.0, 30.0)
    views: Views = {
        name: [(frame, only_part(view, board, bool(rng.random() < 0.5))) for frame, view in own]
        for name, own in rig_views(rng, 25).items()
    }
    rig = calibrate_rig(views, sizes(), model=MODELS)
    assert rig.left_out == ()
    assert_true_mounts(rig)


@pytest.mark.parametrize("shift_px", [30.0, 3.0])
def test_frames_not_taken_at_one_moment(shift_px: float, rng: np.random.Generator) -> None:
    """A fifth of the frames with the wide camera's board elsewhere, far or by a little: left out, and only these."""
    views = rig_views(rng, 25)
    limit = np.array(sizes()["wide"]) - 1.0
    free = [frame for frame, view in views["wide"] if (view.pixels + shift_px < limit).all()]
    late = set(free[::5])
    assert len(late) >= 4
    views["wide"] = [
        (frame, replace(view, pixels=view.pixels + shift_px) if frame in late else view)
        for frame, view in views["wide"]
    ]
    rig = calibrate_rig(views, sizes(), model=MODELS)
    assert {frame for frame, _, _ in rig.left_out} == late
    assert all("disagree" in reason for _, _, reason in rig.left_out)
    assert_true_mounts(rig)


def test_nothing_in_common_is_said(rng: np.random.Generator) -> None:
    """Two cameras of which every frame was taken at another moment."""
    views = {name: own for name, own in rig_views(rng, 16).items() if name != "fish"}
    frames = [frame for frame, _ in views["wide"]]
    shuffled = dict(zip(frames, np.roll(frames, 3).tolist(), strict=True))
    views["wide"] = [(shuffled[frame], view) for frame, view in views["wide"]]
    try:
        rig = calibrate_rig(views, sizes(), model=MODELS)
    except DegenerateError as error:
        assert "disagree" in str(error)
    else:
        assert rig.sigma_px > 10.0 * NOISE_PX or len(rig.left_out) > len(frames) / 2


@pytest.mark.parametrize("board", [Board("a", 8, 6, 30.0, 20.0), Board("b", 4, 4, 25.0, 25.0)])
def test_turned_counts_the_same_corners_from_elsewhere(board: Board, rng: np.random.Generator) -> None:
    pose = Rigid3(exp_so3(rng.normal(size=3)), rng.normal(size=3) * 100.0)
    view = BoardView("i", board, board.grid(), rng.random((board.corner_count, 2)), np.ones(board.corner_count))
    seen = Seen(view, np.ones(board.corner_count, dtype=bool), pose, np.zeros(board.corner_count), "f", ("f", "b"))
    for turns in (2,) if board.columns != board.rows else (1, 2, 3):
        other = seen.counted(turns)
        assert not np.array_equal(other.view.grid, view.grid)
        assert np.allclose(other.cam_from_board.apply(other.view.points()), pose.apply(view.points()))
