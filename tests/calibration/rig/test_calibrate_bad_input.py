"""Rigs with wrongly named, weighted or tied views: refused or reported."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from helpers.board_rig_scenes import ALIKE, corner_of_a_room, target_views
from helpers.calibration_scenes import BOARD, lens

from rigkit.calibration.rig.calibrate import calibrate_rig
from rigkit.calibration.rig.compare import compare_mounts
from rigkit.calibration.rig.mounted import MountedCameras
from rigkit.calibration.rig.result import RigCalibration
from rigkit.cameras.base import Camera
from rigkit.core.boards import Board
from rigkit.core.detections import BoardView
from rigkit.core.errors import InputError
from rigkit.geometry.rigid3 import Rigid3
from rigkit.geometry.rotation import exp_so3

NOISE_PX = 0.1
CAMERAS: dict[str, tuple[Camera, Rigid3]] = {
    "reg": (lens("reg"), Rigid3.identity()),
    "wide": (lens("wide"), Rigid3(exp_so3(np.array([0.02, -0.1, 0.3])), [-120.0, 15.0, 5.0])),
}
MODELS = {"reg": "brown", "wide": "kannala_brandt"}
Views = dict[str, list[tuple[str, BoardView]]]


def board_views(rng: np.random.Generator, frames: int) -> Views:
    """Return frames in which both cameras see the one board."""
    out: Views = {name: [] for name in CAMERAS}
    while len(out["reg"]) < frames:
        turn = exp_so3(rng.normal(size=3) * [0.45, 0.45, 1.5])
        middle = np.array([rng.uniform(-160, 160), rng.uniform(-110, 110), rng.uniform(350, 700)])
        rig_from_board = Rigid3(turn, middle - turn @ BOARD.points().mean(axis=0))
        seen = {}
        for name, (camera, cam_from_rig) in CAMERAS.items():
            pixels, valid = camera.project((cam_from_rig @ rig_from_board).apply(BOARD.points()))
            if valid.all() and (pixels > 2.0).all() and (pixels < np.array(camera.size_px) - 3.0).all():
                seen[name] = pixels + NOISE_PX * rng.normal(size=pixels.shape)
        if len(seen) == len(CAMERAS):
            frame = f"{len(out['reg']):03d}"
            for name, pixels in seen.items():
                view = BoardView(f"{name}{frame}", BOARD, BOARD.grid(), pixels, np.full(len(pixels), NOISE_PX))
                out[name].append((frame, view))
    return out


def solved(views: Views, boards: tuple[Board, ...] = (), board: str = "flat", folds: int = 0) -> RigCalibration:
    return calibrate_rig(
        views,
        {name: CAMERAS[name][0].size_px for name in views},
        model={name: MODELS[name] for name in views},
        board=board,
        rigid_boards=[[b.board_id for b in boards]] if boards else [],
        folds=folds,
    )


def test_what_all_corners_of_a_camera_are_said_to_be_off_by_says_nothing(rng: np.random.Generator) -> None:
    """A camera's noise is what it leaves: sigmas that are five times too large for all its corners change nothing."""
    views = board_views(rng, 12)
    printed = {name: [(f, replace(v, sigma_px=(5.0 if name == "wide" else 1.0) * v.sigma_px)) for f, v in own]
            for name, own in views.items()}  # fmt: skip
    one, other = solved(views), solved(printed)
    assert other.sigma_px == pytest.approx(one.sigma_px, rel=1e-6)
    assert np.allclose(other.cameras[1].cam_from_rig.matrix(), one.cameras[1].cam_from_rig.matrix(), atol=1e-4)


WRONG: dict[str, tuple[Callable[[Views], Views], str]] = {
    "two images of one frame": (
        lambda views: {**views, "reg": [(views["reg"][0][0], v) for _, v in views["reg"][:2]] + views["reg"][2:]},
        "camera 'reg'.*'9x6' twice in frame '000'",
    ),
    "one image of two frames": (
        lambda views: {**views, "wide": [(f, replace(v, image="same.png")) for f, v in views["wide"]]},
        "camera 'wide'.*'same.png'",
    ),
}


@pytest.mark.parametrize("what", WRONG)
def test_frames_are_one_image_of_each_camera(what: str, rng: np.random.Generator) -> None:
    wrong, words = WRONG[what]
    with pytest.raises(InputError, match=words):
        solved(wrong(board_views(rng, 6)))


def test_cameras_without_a_size_or_a_model_are_named(rng: np.random.Generator) -> None:
    views = board_views(rng, 3)
    sizes = {name: camera.size_px for name, (camera, _) in CAMERAS.items()}
    with pytest.raises(InputError, match=r"sizes_px.*'wide'"):
        calibrate_rig(views, {"reg": sizes["reg"]}, model=MODELS)
    with pytest.raises(InputError, match=r"model.*'wide'"):
        calibrate_rig(views, sizes, model={"reg": "brown"})
    with pytest.raises(InputError, match=r"degree.*'wide'"):
        calibrate_rig(views, sizes, model=MODELS, degree={"reg": None})


@pytest.mark.parametrize("order", [("wide", "reg"), ("reg", "wide")])
@pytest.mark.parametrize("board", ["flat", "warp"])
def test_boards_have_the_names_of_their_views(order: tuple[str, str], board: str, rng: np.random.Generator) -> None:
    """One camera sees the second and the third of three boards, and calls them the first and the second."""
    room = corner_of_a_room(rng, ALIKE)
    views = target_views(rng, CAMERAS, ALIKE, room, 8, noise_px=NOISE_PX, distance_mm=1000.0)
    called = {"plane2": ALIKE[0], "plane3": ALIKE[1]}
    views["wide"] = [
        (f, replace(v, board=called[v.board.board_id])) for f, v in views["wide"] if v.board.board_id in called
    ]
    rig = solved({name: views[name] for name in order}, ALIKE, board)
    assert rig.verdicts[0].severity == "good"
    for camera in rig.cameras:
        boards = {b.board_id: b for b in camera.calibration.boards}
        assert boards.keys() == {v.board_id for v in camera.calibration.views}
        placed = {b.board.board_id: b for b in rig.board_rigs[0].boards}
        for name, shape in boards.items():
            assert np.array_equal(shape.points_mm, placed[name].points_mm)
            flat = shape.points_mm - shape.points_mm.mean(axis=0)
            bow = np.abs(flat @ np.linalg.svd(flat)[2][2]).max()
            assert shape.bow_mm == pytest.approx(bow, abs=1e-9)


def test_a_mount_that_one_fold_alone_tells_has_no_held_out_error(rng: np.random.Generator) -> None:
    """Without this frame nothing says where the second camera sits: there is nothing to hold out."""
    views = board_views(rng, 15)
    views["wide"] = [(f if int(f) == 5 else f"alone{f}", v) for f, v in views["wide"]]
    rig = solved(views, folds=5)
    assert rig.shared_count == 1 and rig.heldout_rms_px is None
    assert solved(board_views(rng, 15), folds=5).heldout_rms_px is not None


def test_one_camera_has_no_mount_to_compare() -> None:
    covariance = np.zeros((lens("reg").parameters.size,) * 2)
    only = MountedCameras(cameras={"only": (lens("reg"), Rigid3.identity())}, covariance=covariance)
    found = compare_mounts(only, only)
    assert found.mounts == () and found.same
