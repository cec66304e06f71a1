"""Symmetric boards in rigs, and frames that were not taken at one moment."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from helpers.calibration_scenes import BOARD
from helpers.rig_scenes import NOISE_PX, SIGMAS, Views, mounts, rig_views, sizes

from rigkit.calibration.rig.calibrate import calibrate_rig
from rigkit.calibration.rig.result import RigCalibration
from rigkit.calibration.rig.views.observations import Observation
from rigkit.core.boards import Board
from rigkit.core.detections import BoardView
from rigkit.core.errors import DegenerateError
from rigkit.core.findings import Severity
from rigkit.geometry.rigid3 import Rigid3
from rigkit.geometry.rotation import exp_so3, rotation_angle

MODELS = {"reg": "brown", "wide": "kannala_brandt", "fish": "kannala_brandt"}
FRAMES = 6
"""That are repeated three times each."""


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


@pytest.mark.parametrize("frames", [4, 16])
def test_nothing_in_common_is_said(frames: int, rng: np.random.Generator) -> None:
    """Two cameras of which every frame was taken at another moment: no rig comes out of it (100 of 100 seeds)."""
    views = {name: own for name, own in rig_views(rng, frames).items() if name != "fish"}
    seen = [frame for frame, _ in views["wide"]]
    shuffled = dict(zip(seen, np.roll(seen, max(1, frames // 5)).tolist(), strict=True))
    views["wide"] = [(shuffled[frame], view) for frame, view in views["wide"]]
    with pytest.raises(
        DegenerateError, match="taken at the same time, and that no two cameras are mixed up"
    ) as reported:
        calibrate_rig(views, sizes(), model=MODELS, folds=0)
    assert "e+0" not in str(reported.value)


def nearly_still(rng: np.random.Generator, frames: int) -> Views:
    """Return frames of two cameras, each with another board before it, which hardly moves."""
    views: Views = {"reg": [], "wide": []}
    for name, own in views.items():
        camera = mounts()[name][0]
        while len(own) < frames:
            rotation = exp_so3(rng.normal(size=3) * np.array([0.15, 0.15, 0.1]))
            middle = rotation @ BOARD.points().mean(axis=0)
            where = np.array([rng.uniform(-15, 15), rng.uniform(-15, 15), rng.uniform(400, 520)])
            pixels, valid = camera.project(Rigid3(rotation, where - middle).apply(BOARD.points()))
            if valid.all() and camera.on_image(pixels).all():
                noisy = np.clip(pixels + NOISE_PX * rng.normal(size=pixels.shape), 0.0, np.array(camera.size_px) - 1.0)
                frame = str(len(own))
                view = BoardView(f"{name}{frame}.png", BOARD, BOARD.grid(), noisy, np.full(len(noisy), NOISE_PX))
                own.append((frame, view))
    return views


def test_a_solution_that_runs_away_is_no_rig() -> None:
    """Boards that hardly move agree to 4 % of their size; with the lenses held the solution then ended 2000 px away."""
    views = nearly_still(np.random.default_rng(0), 12)
    try:
        rig = calibrate_rig(views, sizes(), model=MODELS, folds=0)
    except DegenerateError as error:
        assert "taken at the same time, and that no two cameras are mixed up" in str(error)
    else:
        assert rig.rms_px < 100.0


def moved_once(views: Views, by_mm: float, rng: np.random.Generator) -> tuple[Views, str]:
    """Return the views with the board moved before the wide camera took one of its images, and the frame."""
    frame, view = views["wide"][1]
    camera = mounts()["wide"][0]
    alone = calibrate_rig(views, sizes(), model=MODELS, folds=0).single[list(views).index("wide")]
    pose = next(v.cam_from_board for v in alone.views if v.image == view.image)
    shift = rng.normal(size=3)
    there = Rigid3(np.eye(3), by_mm * shift / np.linalg.norm(shift)) @ pose
    pixels = view.pixels + camera.project(there.apply(view.points()))[0] - camera.project(pose.apply(view.points()))[0]
    moved = replace(view, pixels=np.clip(pixels, 0.0, np.array(camera.size_px) - 1.0))
    return {**views, "wide": [(f, moved if f == frame else v) for f, v in views["wide"]]}, frame


@pytest.mark.parametrize("frames", [4, 10])
def test_one_frame_in_which_the_board_was_moved(frames: int, rng: np.random.Generator) -> None:
    """Among four, one moved by 3 mm pulls the mount so far that all look bad; it is found all the same, and alone."""
    views = {name: own for name, own in rig_views(rng, frames).items() if name != "fish"}
    moved, frame = moved_once(views, 3.0, rng)
    rig = calibrate_rig(moved, sizes(), model=MODELS, folds=0)
    assert [left[0] for left in rig.left_out] == [frame]
    length, sigma = rig.baseline_mm("reg", "wide")
    assert abs(length - np.linalg.norm(mounts()["wide"][1].translation_mm)) < SIGMAS * sigma


@pytest.mark.slow
def test_false_alarms_and_detections() -> None:
    """No clean frame is left out, flat boards or bumpy ones; boards moved by 1 mm are found 9 times of 10."""
    found = 0
    for seed in range(30):
        rng = np.random.default_rng(seed)
        bumps = 0.1 * rng.normal(size=(54, 3)) * np.array([0.3, 0.3, 1.0]) if seed % 2 else np.zeros((54, 3))
        views = {n: own for n, own in rig_views(rng, 8, bumps_mm=bumps).items() if n != "fish"}
        assert calibrate_rig(views, sizes(), model=MODELS, folds=0).left_out == ()
        moved, frame = moved_once(views, 1.0, rng)
        left_out = calibrate_rig(moved, sizes(), model=MODELS, folds=0).left_out
        assert {left[0] for left in left_out} <= {frame}
        found += len(left_out)
    assert found >= 27


def test_one_pose_of_a_board_that_looks_the_same_turned_is_said(rng: np.random.Generator) -> None:
    """One frame cannot tell which of two mounts it is: the smaller turn is taken, and said to be."""
    board = Board("8x6", 8, 6, 30.0, 30.0)
    views: Views = {"reg": [], "wide": []}
    every = {name: own for name, own in rig_views(rng, 12).items() if name != "fish"}
    for name, own in every.items():
        # Intrinsics from frames of their own, the mount from one frame.
        for k, (frame, view) in enumerate(own):
            views[name].append(
                (frame if k == 0 else f"{name}{frame}", only_part(view, board, bool(rng.random() < 0.5)))
            )
    rig = calibrate_rig(views, sizes(), model=MODELS)
    assert any("are symmetric" in verdict.message for verdict in rig.verdicts)
    true = mounts()["wide"][1]
    assert np.degrees(rotation_angle(rig.cameras[1].cam_from_rig.rotation @ true.rotation.T)) < 2.0


@pytest.mark.parametrize("board", [Board("a", 8, 6, 30.0, 20.0), Board("b", 4, 4, 25.0, 25.0)])
def test_turned_counts_the_same_corners_from_elsewhere(board: Board, rng: np.random.Generator) -> None:
    pose = Rigid3(exp_so3(rng.normal(size=3)), rng.normal(size=3) * 100.0)
    view = BoardView("i", board, board.grid(), rng.random((board.corner_count, 2)), np.ones(board.corner_count))
    seen = Observation(
        view, np.ones(board.corner_count, dtype=bool), pose, np.zeros(board.corner_count), "f", ("f", "b")
    )
    for turns in (2,) if board.columns != board.rows else (1, 2, 3):
        other = seen.turned(turns)
        assert not np.array_equal(other.view.grid, view.grid)
        assert np.allclose(other.cam_from_board.apply(other.view.points()), pose.apply(view.points()))


def test_a_rig_without_a_common_trigger_is_said_to_be_bad_and_its_sigmas_hold(rng: np.random.Generator) -> None:
    """The board moves in every frame while three cameras look at it one after the other: by some pixels, many times
    the corners' noise, and next to nothing of the board's size."""
    views = rig_views(rng, 30)
    for name in ("wide", "fish"):
        limit = np.array(sizes()[name]) - 0.5
        moved = [rng.normal(0.0, 60.0 * NOISE_PX, 2) for _ in views[name]]
        views[name] = [
            (frame, replace(view, pixels=np.clip(view.pixels + shift, -0.5, limit)))
            for (frame, view), shift in zip(views[name], moved, strict=True)
        ]
    rig = calibrate_rig(views, sizes(), model=MODELS)
    assert not rig.left_out
    first = rig.verdicts[0]
    assert first.severity is Severity.BAD and "not simultaneous" in first.message
    for name in ("wide", "fish"):
        length, sigma = rig.baseline_mm("reg", name)
        assert abs(length - np.linalg.norm(mounts()[name][1].translation_mm)) < SIGMAS * sigma
        # What it says of itself is of the size of the disagreement, not of the corners' noise.
        assert sigma > 0.1


def test_frames_that_repeat_others_are_held_out_with_them(rng: np.random.Generator) -> None:
    """Else those that are left out would be known from their copies, and neither the headline nor the sigmas would be
    true."""

    def once_more(view: BoardView, k: int) -> BoardView:
        noisy = view.pixels + 0.02 * rng.normal(size=view.pixels.shape)
        return replace(view, image=f"{k} {view.image}", pixels=np.clip(noisy, 0.0, np.array(sizes()["reg"]) - 1.0))

    def bent(pixels: np.ndarray) -> np.ndarray:
        """What the corners of a frame have in common is what another frame does not tell."""
        return np.clip(pixels + 0.5 * np.sin(pixels / 150.0 + rng.uniform(0.0, 6.0, 2)), 0.0, None)

    views = {
        name: [(f, replace(v, pixels=bent(v.pixels))) for f, v in own] for name, own in rig_views(rng, FRAMES).items()
    }
    copied = {name: [(f"{f} {k}", once_more(v, k)) for f, v in own for k in range(3)] for name, own in views.items()}
    once, thrice = (calibrate_rig(own, sizes(), model=MODELS) for own in (views, copied))
    assert once.heldout_rms_px is not None and thrice.heldout_rms_px is not None
    assert thrice.heldout_rms_px > 0.9 * once.heldout_rms_px
    assert thrice.freedom < FRAMES
    assert np.median(thrice.sigmas / once.sigmas) > 0.75
