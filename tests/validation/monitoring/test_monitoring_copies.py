"""`rigkit check` of rigs with a wall of copies: which is which in two cameras follows from their arrangement."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from helpers.calibration_scenes import lens
from helpers.monitoring_scenes import NOISE_PX, known_rig

from rigkit.core.boards import Board
from rigkit.core.detections import BoardView
from rigkit.geometry.rigid3 import Rigid3
from rigkit.geometry.rotation import exp_so3
from rigkit.validation.monitoring.copies import with_copies_shared
from rigkit.validation.monitoring.evidence import FreshView
from rigkit.validation.monitoring.flipped import consistently_numbered
from rigkit.validation.monitoring.verdict import CalibrationCheck, check_views

MOUNT = Rigid3(exp_so3(np.array([0.01, -0.08, 0.02])), [-120.0, 2.0, 3.0])
RIG = known_rig(MOUNT, [0.1, 0.1, 0.1, 0.1, 2e-5, 2e-5, 2e-5, 2e-5], 2e-5, 20.0)
COPY = Board("copy", 8, 6, 20.0, 20.0)
COPIES = 4


def wall(right_from_left: Rigid3, rng: np.random.Generator) -> list[FreshView]:
    """Return the views of copies in three frames, named in another order by the second camera, and turned."""
    views = []
    for frame in range(3):
        tilts = rng.normal(size=(COPIES, 3)) * np.array([0.3, 0.3, 0.4])
        aside = np.array([[230.0 * (k - 1.5), *rng.uniform(-60.0, 60.0, 2)] for k in range(COPIES)])
        for camera, motion in enumerate((Rigid3.identity(), right_from_left)):
            for number, k in enumerate(rng.permutation(COPIES).tolist()):
                held = motion @ Rigid3(exp_so3(tilts[k]), aside[k] + [0.0, 0.0, 700.0])
                pixels, valid = lens("wide").project(held.apply(COPY.points() - COPY.points().mean(axis=0)))
                assert valid.all()
                board = replace(COPY, board_id=f"copy part of {frame} of {camera} ({number})")
                grid = COPY.grid() if camera == 0 else np.array(COPY.size) - 1 - COPY.grid()
                noisy = pixels + NOISE_PX * rng.normal(size=pixels.shape)
                view = BoardView(f"{frame}", board, grid, noisy, np.full(len(grid), NOISE_PX))
                views.append(FreshView(f"{frame}", camera, view))
    return views


def checked(views: list[FreshView]) -> CalibrationCheck:
    out: list[FreshView] = []
    for fresh in with_copies_shared(RIG, views):
        out.append(consistently_numbered(RIG, fresh, out))
    return check_views(RIG, out)


def test_a_camera_that_turned_is_found_from_copies(rng: np.random.Generator) -> None:
    turn = exp_so3(np.radians([0.02, -0.015, 0.03]))
    check = checked(wall(Rigid3(turn @ MOUNT.rotation, turn @ MOUNT.translation_mm), rng))
    assert not check.holds and check.change is not None
    assert (check.change.hypothesis.kind, check.change.hypothesis.camera) == ("rotation", "right")


def test_an_unchanged_rig_holds_for_copies(rng: np.random.Generator) -> None:
    views = wall(MOUNT, rng)
    shared = {(view.frame, view.view.board.board_id) for view in with_copies_shared(RIG, views)}
    assert len(shared) == 3 * COPIES == len(views) // 2
    assert checked(views).holds


def test_two_copies_in_a_frame_are_not_matched(rng: np.random.Generator) -> None:
    """Two of each camera fit by chance."""
    few = [view for view in wall(MOUNT, rng) if view.view.board.board_id.endswith(("(0)", "(1)"))]
    assert len({view.view.board.board_id for view in with_copies_shared(RIG, few)}) == len(few)


def test_a_bent_board_has_its_calibrated_shape_from_whichever_end_it_is_numbered(rng: np.random.Generator) -> None:
    """As that of REAL bumblebee2, of whose unchanged pairs two in five fitted a flat board."""
    bent = COPY.points() + rng.normal(size=(COPY.corner_count, 3)) * np.array([0.02, 0.02, 0.2])
    known = replace(RIG, boards_mm={COPY.board_id: bent})
    views: list[FreshView] = []
    for camera, motion in enumerate((Rigid3.identity(), MOUNT)):
        held = motion @ Rigid3(exp_so3(np.array([0.3, 0.4, 0.1])), [-80.0, -50.0, 500.0])
        pixels, valid = lens("wide").project(held.apply(bent))
        assert valid.all() and COPY.looks_same_turned
        noisy = pixels + NOISE_PX * rng.normal(size=pixels.shape)
        grid = np.array(COPY.size) - 1 - COPY.grid()
        view = BoardView("0", COPY, grid, noisy, np.full(len(grid), NOISE_PX))
        views.append(consistently_numbered(known, FreshView("0", camera, view), views))
    assert all((one.view.grid == COPY.grid()).all() for one in views)
    assert check_views(known, views).rms_px < 2.0 * NOISE_PX < check_views(RIG, views).rms_px
