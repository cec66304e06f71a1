"""Boards mounted to each other: their geometry and its sigmas, names by arrangement, what they add for a camera."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import replace
from operator import methodcaller

import numpy as np
import pytest
from helpers.board_rig_scenes import ALIKE, DIFFERENT, corner_of_a_room, target_views
from helpers.calibration_scenes import lens

from rigkit.calibration.calibrate import calibrate
from rigkit.calibration.rig.board_rig import BoardRig, MountedBoard
from rigkit.calibration.rig.board_ties import suggest_rigid_boards
from rigkit.calibration.rig.calibrate import calibrate_rig
from rigkit.calibration.rig.compare import compare_board_rigs
from rigkit.calibration.rig.result import RigCalibration
from rigkit.cameras.base import Camera
from rigkit.core.boards import Board
from rigkit.core.detections import BoardView
from rigkit.core.errors import InputError
from rigkit.core.findings import Severity
from rigkit.core.truth import Feature
from rigkit.geometry.rigid3 import Rigid3
from rigkit.geometry.rotation import angle_between, exp_so3

NOISE_PX = 0.1
SIGMAS = 4.0
"""Further from the truth in its own standard deviations is wrong: 1 in 16000 by chance."""
REG: dict[str, tuple[Camera, Rigid3]] = {"reg": (lens("reg"), Rigid3.identity())}
PAIR: dict[str, tuple[Camera, Rigid3]] = {
    **REG,
    "wide": (lens("wide"), Rigid3(exp_so3(np.array([0.02, -0.1, 0.3])), [-120.0, 15.0, 5.0])),
}
MODELS = {"reg": "brown", "wide": "kannala_brandt"}
Views = dict[str, list[tuple[str, BoardView]]]


def solve(views: Views, boards: tuple[Board, ...], board: str = "flat", folds: int = 0) -> RigCalibration:
    sizes = {name: PAIR[name][0].size_px for name in views}
    models = {name: MODELS[name] for name in views}
    return calibrate_rig(
        views, sizes, model=models, board=board, rigid_boards=[[b.board_id for b in boards]], folds=folds
    )


def true_angle_deg(room: dict[str, Rigid3], a: str, b: str) -> float:
    return float(180.0 - np.degrees(angle_between(room[a].rotation[:, 2], room[b].rotation[:, 2])))


def errors_in_sigmas(rig: RigCalibration, room: dict[str, Rigid3], boards: tuple[Board, ...]) -> list[float]:
    """Angles, distances of centres, and distances of first corners to the other boards' planes."""
    found = rig.board_rigs[0]
    middle = {b.board_id: room[b.board_id].apply(b.points().mean(axis=0)) for b in boards}
    out = []
    for a, b in [(a.board_id, b.board_id) for a in boards for b in boards if a is not b]:
        angle, sigma = found.angle_deg(a, b)
        out.append((angle - true_angle_deg(room, a, b)) / sigma)
        length, sigma = found.distance_mm(Feature(a, centre=True), Feature(b, centre=True))
        out.append((length - float(np.linalg.norm(middle[a] - middle[b]))) / sigma)
        height, sigma = found.distance_mm(Feature(b), Feature(a, grid=(0, 0)))
        true = abs(float(room[b].rotation[:, 2] @ (room[a].translation_mm - room[b].translation_mm)))
        out.append((height - true) / sigma)
    return out


def check_sigmas(cameras: dict[str, tuple[Camera, Rigid3]], frames: int, runs: int, low: float, high: float) -> None:
    z = []
    focal = []
    for seed in range(runs):
        rng = np.random.default_rng(seed)
        room = corner_of_a_room(rng, DIFFERENT)
        views = target_views(rng, cameras, DIFFERENT, room, frames, noise_px=NOISE_PX, distance_mm=1000.0)
        rig = solve(views, DIFFERENT)
        assert rig.left_out == () and rig.sigma_px == pytest.approx(NOISE_PX, rel=0.15)
        z += errors_in_sigmas(rig, room, DIFFERENT)
        for camera in rig.cameras:
            off = camera.camera.parameters - cameras[camera.name][0].parameters
            focal.append(off[0] / camera.calibration.parameter_sigmas[0])
    assert low < np.sqrt(np.mean(np.square(z))) < high
    # One number a run, so twice as loose where there are few runs.
    assert 2.0 * low - 1.0 < np.sqrt(np.mean(np.square(focal))) < 2.0 * high - 1.0


def test_sigmas_are_those_of_the_errors() -> None:
    check_sigmas(REG, 4, 12, 0.75, 1.35)


@pytest.mark.slow
@pytest.mark.parametrize(("cameras", "frames"), [(REG, 1), (REG, 4), (PAIR, 6)], ids=["image", "camera", "rig"])
def test_sigmas_by_monte_carlo(cameras: dict[str, tuple[Camera, Rigid3]], frames: int) -> None:
    """100 runs know a standard deviation to 7 %; all of them together promise 15 %."""
    check_sigmas(cameras, frames, 100, 0.85, 1.15)


@pytest.mark.parametrize("board", ["flat", "warp"])
def test_boards_that_look_alike_are_told_by_their_arrangement(board: str, rng: np.random.Generator) -> None:
    """Names and first corners are random in every image."""
    room = corner_of_a_room(rng, ALIKE)
    views = target_views(rng, REG, ALIKE, room, 8, noise_px=NOISE_PX, distance_mm=1000.0, shuffled=True)
    rig = solve(views, ALIKE, board)
    assert rig.left_out == () and len(rig.verdicts) == 1 and rig.verdicts[0].severity == "good"
    assert rig.sigma_px == pytest.approx(NOISE_PX, rel=0.1)
    found = rig.board_rigs[0]
    assert found.image_count == 8
    pairs = [("plane1", "plane2"), ("plane1", "plane3"), ("plane2", "plane3")]
    true = sorted(true_angle_deg(room, *pair) for pair in pairs)
    for (angle, sigma), expected in zip(sorted(found.angle_deg(*pair) for pair in pairs), true, strict=True):
        assert abs(angle - expected) < SIGMAS * sigma


def test_two_cameras_and_boards_that_look_alike(rng: np.random.Generator) -> None:
    """Each camera names and counts them at random; the arrangement makes both mean the same."""
    room = corner_of_a_room(rng, ALIKE)
    views = target_views(rng, PAIR, ALIKE, room, 8, noise_px=NOISE_PX, distance_mm=1000.0, shuffled=True)
    rig = solve(views, ALIKE)
    assert rig.left_out == () and rig.shared_count == 8
    assert rig.sigma_px == pytest.approx(NOISE_PX, rel=0.1)
    length, sigma = rig.baseline_mm("reg", "wide")
    assert abs(length - np.linalg.norm(PAIR["wide"][1].translation_mm)) < SIGMAS * sigma < 1.0


def test_boards_that_only_neighbours_link(rng: np.random.Generator) -> None:
    """No image shows all three: floor and left, or left and right."""
    room = corner_of_a_room(rng, DIFFERENT)
    views = target_views(rng, REG, DIFFERENT, room, 10, noise_px=NOISE_PX, distance_mm=1000.0)
    hidden = ("right", "floor")
    views["reg"] = [(f, v) for f, v in views["reg"] if v.board.board_id != hidden[int(f) % 2]]
    rig = solve(views, DIFFERENT)
    assert sorted(rig.board_rigs[0].names) == ["floor", "left", "right"] and rig.shared_count == 10
    assert max(abs(e) for e in errors_in_sigmas(rig, room, DIFFERENT)) < SIGMAS


def test_sigmas_of_angles_and_distances_follow_the_covariance(rng: np.random.Generator) -> None:
    """Against central differences by every number of the places."""
    room = corner_of_a_room(rng, DIFFERENT)
    root = 1e-2 * rng.normal(size=(12, 12)) * np.tile([1e-2, 1e-2, 1e-2, 1.0, 1.0, 1.0], 2)[:, None]
    first = room["floor"].inverse()
    poses = [first @ room[b.board_id] for b in DIFFERENT]

    def rig(x: np.ndarray) -> BoardRig:
        moved = [poses[0]] + [
            Rigid3(exp_so3(d[:3]) @ pose.rotation, pose.translation_mm + d[3:])
            for pose, d in zip(poses[1:], x.reshape(2, 6), strict=True)
        ]
        placed = [MountedBoard(b, b.points(), pose) for b, pose in zip(DIFFERENT, moved, strict=True)]
        return BoardRig(tuple(placed), root @ root.T, 1)

    quantities: list[Callable[[BoardRig], tuple[float, float]]] = []
    for a, b in [("floor", "left"), ("left", "right"), ("right", "floor")]:
        between = ((Feature(a, centre=True), Feature(b, grid=(2, 3))), (Feature(a), Feature(b, grid=(5, 1))))
        quantities.append(methodcaller("angle_deg", a, b))
        quantities += [methodcaller("distance_mm", *features) for features in between]
    for quantity in quantities:
        steps = 1e-6 * np.eye(12)
        slope = np.array([(quantity(rig(d))[0] - quantity(rig(-d))[0]) / 2e-6 for d in steps])
        assert quantity(rig(np.zeros(12)))[1] == pytest.approx(np.linalg.norm(slope @ root), rel=1e-5)


def test_sigmas_from_few_images_are_widened() -> None:
    places = (Rigid3.identity(), Rigid3(exp_so3(np.array([0.0, 1.5, 0.0])), [300.0, 0.0, 0.0]))
    placed = tuple(MountedBoard(b, b.points(), p) for b, p in zip(DIFFERENT[:2], places, strict=True))
    names = [b.board_id for b in DIFFERENT[:2]]
    of_many, of_few = (BoardRig(placed, 1e-6 * np.eye(6), 5, 0.0, freedom) for freedom in (float("inf"), 4.0))
    ends = [Feature(name, centre=True) for name in names]
    # Two standard deviations of a normal distribution are 2.87 of Student's with four degrees of freedom.
    for quoted, known in (
        (of_few.angle_deg(*names), of_many.angle_deg(*names)),
        (of_few.distance_mm(*ends), of_many.distance_mm(*ends)),
    ):
        assert quoted[0] == known[0] and quoted[1] == pytest.approx(1.4347 * known[1], rel=1e-3)


def test_one_image_is_as_good_as_three_boards_alone(rng: np.random.Generator) -> None:
    """With one image there is nothing to tie: as many unknowns, the same camera; and the boards' geometry."""
    room = corner_of_a_room(rng, DIFFERENT)
    views = target_views(rng, REG, DIFFERENT, room, 1, noise_px=NOISE_PX, distance_mm=1000.0)
    rig = solve(views, DIFFERENT)
    off = rig.cameras[0].camera.parameters - rig.single[0].camera.parameters
    # The priors are weighed by two estimates of the noise.
    assert np.abs(off / rig.single[0].parameter_sigmas).max() < 0.02
    assert max(abs(e) for e in errors_in_sigmas(rig, room, DIFFERENT)) < SIGMAS


@pytest.mark.parametrize("frames", [1, 2])
def test_too_few_images_for_a_shape_leave_the_boards_flat(frames: int, rng: np.random.Generator) -> None:
    room = corner_of_a_room(rng, DIFFERENT)
    views = target_views(rng, REG, DIFFERENT, room, frames, noise_px=NOISE_PX, distance_mm=1000.0)
    rig = solve(views, DIFFERENT, "auto")
    assert all(shape.bow_mm < 1e-3 for shape in rig.cameras[0].calibration.boards)
    assert max(abs(e) for e in errors_in_sigmas(rig, room, DIFFERENT)) < SIGMAS


def test_tied_boards_lower_the_uncertainty_of_a_camera() -> None:
    """Three images: 30 unknown numbers of poses and places instead of 54."""
    tied, alone, surer = [], [], []
    for seed in range(12):
        rng = np.random.default_rng(seed)
        room = corner_of_a_room(rng, DIFFERENT)
        views = target_views(rng, REG, DIFFERENT, room, 3, noise_px=NOISE_PX, distance_mm=1000.0)
        rig = solve(views, DIFFERENT)
        truth = lens("reg").parameters
        tied.append(rig.cameras[0].camera.parameters[:4] - truth[:4])
        alone.append(rig.single[0].camera.parameters[:4] - truth[:4])
        surer.append(rig.cameras[0].calibration.parameter_sigmas[:4] / rig.single[0].parameter_sigmas[:4])
    # Three images know their own disagreement to about half.
    assert (np.median(surer, axis=0) < 1.0).all()
    assert np.square(tied).mean() < 0.6 * np.square(alone).mean()


def test_cameras_that_see_different_boards_of_a_target(rng: np.random.Generator) -> None:
    """No board is seen by both cameras in one frame; the target links them."""
    room = corner_of_a_room(rng, DIFFERENT)
    views = target_views(rng, PAIR, DIFFERENT, room, 12, noise_px=NOISE_PX, distance_mm=1000.0)
    views["wide"] = [(f, v) for f, v in views["wide"] if v.board.board_id == "floor" or int(f) % 3 == 0]
    views["reg"] = [(f, v) for f, v in views["reg"] if v.board.board_id != "floor" or int(f) % 3 == 1]
    views["reg"] = [(f, v) for f, v in views["reg"] if int(f) % 3 != 0]
    shared = {(f, v.board.board_id) for f, v in views["reg"]} & {(f, v.board.board_id) for f, v in views["wide"]}
    views["reg"] = [(f, v) for f, v in views["reg"] if (f, v.board.board_id) not in shared]
    views["reg"] += [
        (f + "x", replace(v, image=v.image + "x"))
        for f, v in target_views(rng, REG, DIFFERENT, room, 3, noise_px=NOISE_PX, distance_mm=1000.0)["reg"]
    ]
    rig = solve(views, DIFFERENT)
    length, sigma = rig.baseline_mm("reg", "wide")
    assert abs(length - np.linalg.norm(PAIR["wide"][1].translation_mm)) < SIGMAS * sigma < 4.0
    assert max(abs(e) for e in errors_in_sigmas(rig, room, DIFFERENT)) < SIGMAS


def test_a_board_that_was_moved_once_is_left_out(rng: np.random.Generator) -> None:
    room = corner_of_a_room(rng, DIFFERENT)
    views = target_views(rng, REG, DIFFERENT, room, 8, noise_px=NOISE_PX, distance_mm=1000.0)
    views["reg"] = [
        (f, replace(v, pixels=v.pixels + 3.0) if (f, v.board.board_id) == ("004", "left") else v)
        for f, v in views["reg"]
    ]
    rig = solve(views, DIFFERENT)
    assert [(frame, target) for frame, target, _ in rig.left_out] == [("004", "floor")]
    assert "one of them was moved" in rig.left_out[0][2]
    assert max(abs(e) for e in errors_in_sigmas(rig, room, DIFFERENT)) < SIGMAS


def test_boards_that_are_not_mounted_to_each_other_are_called_so(rng: np.random.Generator) -> None:
    views: Views = {"reg": []}
    for k in range(6):
        room = corner_of_a_room(rng, DIFFERENT)
        room["left"] = Rigid3(room["left"].rotation, room["left"].translation_mm + 20.0 * rng.normal(size=3))
        own = target_views(rng, REG, DIFFERENT, room, 1, noise_px=NOISE_PX, distance_mm=1000.0)["reg"]
        views["reg"] += [(f"{k}", replace(view, image=f"{k}.png")) for _, view in own]
    first = solve(views, DIFFERENT).verdicts[0]
    assert first.severity is Severity.BAD
    assert "the boards are not rigidly mounted" in first.message and first.remedy == "fasten the boards"


def test_bad_groups_are_explained(rng: np.random.Generator) -> None:
    room = corner_of_a_room(rng, DIFFERENT)
    views = target_views(rng, REG, DIFFERENT, room, 6, noise_px=NOISE_PX, distance_mm=1000.0)
    with pytest.raises(InputError, match="no image shows board 'roof'"):
        calibrate_rig(views, {"reg": lens("reg").size_px}, model="brown", rigid_boards=[["floor", "roof"]])
    apart = {"reg": [(f, v) for f, v in views["reg"] if (v.board.board_id == "right") == (int(f) % 2 == 0)]}
    with pytest.raises(InputError, match="'right' is never seen together"):
        solve(apart, DIFFERENT)
    alone = {"reg": [(f, v) for f, v in views["reg"] if v.board.board_id == DIFFERENT[int(f) % 3].board_id]}
    with pytest.raises(InputError, match="no image shows two of them"):
        solve(alone, DIFFERENT)


def test_held_out_error_of_a_tied_camera(rng: np.random.Generator) -> None:
    """Frames that took no part fit with one pose for three boards: the noise, a little more."""
    room = corner_of_a_room(rng, DIFFERENT)
    views = target_views(rng, PAIR, DIFFERENT, room, 10, noise_px=NOISE_PX, distance_mm=1000.0)
    rig = solve(views, DIFFERENT, folds=5)
    assert rig.heldout_rms_px == pytest.approx(np.sqrt(2.0) * NOISE_PX, rel=0.05)
    assert all(c.calibration.heldout_rms_px is not None for c in rig.cameras)


@pytest.mark.parametrize("alike", [False, True])
def test_boards_that_keep_their_places_are_noticed(alike: bool, rng: np.random.Generator) -> None:
    boards = ALIKE if alike else DIFFERENT
    room = corner_of_a_room(rng, boards)
    views = [
        v
        for _, v in target_views(rng, REG, boards, room, 5, noise_px=NOISE_PX, distance_mm=1000.0, shuffled=alike)[
            "reg"
        ]
    ]
    if alike:
        # As the program has them where no name can be told: every view shows a board of its own.
        views = [replace(v, board=replace(v.board, board_id=f"part {k}")) for k, v in enumerate(views)]
    result = calibrate(views, REG["reg"][0].size_px, model="brown", board="flat")
    (printed,) = suggest_rigid_boards(views, result)
    assert "kept their relative poses in 5 images" in str(printed)
    assert (
        ("3 boards of 8x6 corners" in str(printed))
        if alike
        else ('boards = ["floor", "left", "right"]' in str(printed))
    )


def declared_as(views: Views, name: str, times: float) -> Views:
    """Return the views with the squares of one board declared so many times as large."""

    def wrong(board: Board) -> Board:
        return replace(board, square_x_mm=times * board.square_x_mm, square_y_mm=times * board.square_y_mm)

    return {
        camera: [(f, replace(v, board=wrong(v.board)) if v.board.board_id == name else v) for f, v in own]
        for camera, own in views.items()
    }


@pytest.mark.parametrize("times", [1.01, 2.0])
def test_a_wrong_size_of_a_mounted_board_is_named(times: float, rng: np.random.Generator) -> None:
    """Of sizes far from the truth no place of the boards fits more than one image."""
    room = corner_of_a_room(rng, DIFFERENT)
    views = target_views(rng, REG, DIFFERENT, room, 8, noise_px=NOISE_PX, distance_mm=1000.0)
    wrong = declared_as(views, DIFFERENT[1].board_id, times)
    boards = tuple({v.board.board_id: v.board for _, v in wrong["reg"]}.values())
    verdicts = solve(wrong, boards).verdicts
    assert verdicts[0].severity is Severity.BAD and "declared sizes of boards" in verdicts[0].message
    ratio = re.search(r"squares of '(\w+)' are ([\d.]+) times", verdicts[0].message)
    assert ratio is not None
    expected = 1.0 / times if ratio[1] == DIFFERENT[1].board_id else times
    assert float(ratio[2]) == pytest.approx(expected, rel=2e-3)
    assert "rigid" not in str(verdicts)
    alone = calibrate([v for _, v in wrong["reg"]], REG["reg"][0].size_px, model="brown", board="flat")
    (printed,) = suggest_rigid_boards([v for _, v in wrong["reg"]], alone)
    assert "declared sizes of boards" in printed.message


def test_boards_that_move_have_no_wrong_sizes() -> None:
    """One of them hardly moves: smaller squares of all others would make them move as little."""
    rng = np.random.default_rng(0)
    views = []
    for k in range(6):
        room = corner_of_a_room(rng, DIFFERENT)
        one = target_views(rng, REG, DIFFERENT, room, 1, noise_px=NOISE_PX, distance_mm=1000.0)["reg"]
        views += [(f"{k}", replace(view, image=f"{k}.png")) for _, view in one]
    still = next(view for _, view in views if view.board.board_id == "floor")
    near = [
        (f, replace(still, image=v.image, pixels=still.pixels + NOISE_PX * rng.normal(size=still.pixels.shape)))
        if v.board.board_id == "floor"
        else (f, v)
        for f, v in views
    ]
    for own in (views, near):
        assert "declared sizes" not in str(solve({"reg": own}, DIFFERENT).verdicts)


def test_boards_that_move_are_not_taken_for_mounted(rng: np.random.Generator) -> None:
    views = []
    for k in range(5):
        room = corner_of_a_room(rng, DIFFERENT)
        own = target_views(rng, REG, DIFFERENT, room, 1, noise_px=NOISE_PX, distance_mm=1000.0)["reg"]
        views += [replace(view, image=f"{k}.png") for _, view in own]
    result = calibrate(views, REG["reg"][0].size_px, model="brown", board="flat")
    assert suggest_rigid_boards(views, result) == ()


def test_mounts_that_did_not_move_are_told_apart_as_often_as_chance_says(rng: np.random.Generator) -> None:
    boards = [Board(name, 8, 6, 30.0, 30.0) for name in ("a", "b", "c")]
    places = [Rigid3.identity(), *(Rigid3(exp_so3(rng.normal(size=3)), rng.normal(size=3) * 100.0) for _ in range(2))]
    spread = rng.normal(size=(12, 12)) * np.tile([1e-4, 1e-4, 1e-4, 0.05, 0.05, 0.05], 2)[:, None]
    covariance = spread @ spread.T

    def drawn(extra: float = 0.0) -> BoardRig:
        error = (spread @ rng.normal(size=12)).reshape(2, 6)
        error[0, 3] += extra
        moved = [
            Rigid3(exp_so3(e[:3]) @ p.rotation, p.translation_mm + e[3:])
            for e, p in zip(error, places[1:], strict=True)
        ]
        placed = tuple(MountedBoard(b, b.points(), p) for b, p in zip(boards, [places[0], *moved], strict=True))
        return BoardRig(placed, covariance, 400)

    chances = np.array([compare_board_rigs(drawn(), drawn(), seed=k).chance for k in range(120)])
    # A binomial count of 120 with chance 0.25 is beyond these once in 10,000 times.
    assert 13 <= (chances < 0.25).sum() <= 48
    assert compare_board_rigs(drawn(), drawn(5.0)).same is False
