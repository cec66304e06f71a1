"""Hand-eye calibration: errors within its sigmas, and messages for degenerate motions."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from helpers.calibration_scenes import lens, noisy_view, random_views
from helpers.stereo_pictures import BOARD as PRINTED
from helpers.stereo_pictures import CAMERA as LENS

from rigkit.calibration.hand_eye import HandEye, hand_eye
from rigkit.cli.main import main
from rigkit.core.detections import BoardView
from rigkit.core.errors import DegenerateError, InputError
from rigkit.geometry.rigid3 import Rigid3
from rigkit.geometry.rotation import exp_so3, log_so3
from rigkit.io.boards.board_file import board_text
from rigkit.io.calibrations.calibration_file import save_camera
from rigkit.synthetic.photometry import Photometry
from rigkit.synthetic.render import Optics, render
from rigkit.synthetic.scene import place_board, sees_paper
from rigkit.workflows.handeye import calibrate_hand_eye
from rigkit.workflows.options.cameras import HandEyeOptions

X = Rigid3(exp_so3(np.array([0.3, -1.2, 0.4])), [30.0, -60.0, 90.0])
Z = Rigid3(exp_so3(np.array([2.0, 0.4, -0.3])), [400.0, 120.0, -15.0])
ROBOT_TURN_RAD, ROBOT_MOVE_MM = 2e-4, 0.1
SEEDS, IMAGES = 20, 15
MAHALANOBIS = (0.7, 1.4)
"""Root mean square error over sigma, 240 numbers of 20 sets that 15 images each determine; those of one set go
together, between 0.4 and 2.3: their mean is known to a tenth."""


def errors(result: HandEye) -> np.ndarray:
    """Return the errors (12,) of both poses as their covariance counts them."""
    out = []
    for found, true in ((result.cam_from_mount, X), (result.stand_from_board, Z)):
        out += [log_so3(found.rotation @ true.rotation.T), found.translation_mm - true.translation_mm]
    return np.concatenate(out)


def capture(
    rng: np.random.Generator,
    count: int = IMAGES,
    *,
    turn_rad: float = ROBOT_TURN_RAD,
    move_mm: float = ROBOT_MOVE_MM,
    board_on_hand: bool = False,
) -> tuple[list[BoardView], list[Rigid3]]:
    """Return views, and mount_from_stand as a robot tells it whose hand errs a little."""
    views, rotations, translations = random_views(lens("reg"), count, rng, reach_deg=25.0, noise_px=0.1)
    reported = []
    for rotation, translation in zip(rotations, translations, strict=True):
        true = X.inverse() @ Rigid3(rotation, translation) @ Z.inverse()
        off = Rigid3(exp_so3(rng.normal(0.0, turn_rad, 3)), rng.normal(0.0, move_mm, 3))
        reported.append(true @ off if board_on_hand else off @ true)
    return views, reported


@pytest.mark.parametrize("board_on_hand", [False, True], ids=["camera", "board"])
@pytest.mark.parametrize(("turn_rad", "move_mm"), [(1e-4, 1.0), (5e-3, 0.1)], ids=["moved", "turned"])
def test_a_robot_noisier_than_the_images_has_its_own_noise(
    turn_rad: float, move_mm: float, board_on_hand: bool, rng: np.random.Generator
) -> None:
    noise, ratios = [], []
    for _ in range(12):
        views, reported = capture(rng, turn_rad=turn_rad, move_mm=move_mm, board_on_hand=board_on_hand)
        result = hand_eye(lens("reg"), views, reported, board_on_hand=board_on_hand)
        noise.append([result.robot_turn_rad / turn_rad, result.robot_move_mm / move_mm])
        ratios.append(
            errors(result) / np.concatenate([own for pair in zip(*result.sigmas(), strict=True) for own in pair])
        )
    # 39 numbers show each of the two variances: medians of twelve are known to 4 %.
    assert np.all(np.abs(np.log(np.median(noise, axis=0))) < 0.15)
    # Of twelve sets; of a hundred 70 to 72 and 96 %.
    assert 0.5 < np.mean(np.abs(ratios) < 1.0) < 0.85 and np.mean(np.abs(ratios) < 2.0) > 0.85
    assert np.sqrt(np.mean(np.square(np.array(ratios)))) < MAHALANOBIS[1]


def test_errors_are_within_their_sigmas(rng: np.random.Generator) -> None:
    ratios = []
    for _ in range(SEEDS):
        result = hand_eye(lens("reg"), *capture(rng))
        ratios.append(errors(result) / np.sqrt(np.diag(result.covariance)))
        assert not result.left_out
    rms = float(np.sqrt(np.mean(np.square(ratios))))
    assert MAHALANOBIS[0] < rms < MAHALANOBIS[1]


@pytest.mark.parametrize("count", [4, 7])
def test_two_sigmas_of_few_images_hold_nearly_all_errors(count: int, rng: np.random.Generator) -> None:
    """95 of 100: of 480 numbers, twelve a set that go together, at least 90."""
    within = []
    for _ in range(40):
        result = hand_eye(lens("reg"), *capture(rng, count))
        sigmas = np.concatenate([own for pair in zip(*result.sigmas(), strict=True) for own in pair])
        within.append(np.abs(errors(result)) < 2.0 * sigmas)
    assert 0.9 <= np.mean(within) <= 0.99


def test_an_exact_robot_gives_an_exact_answer(rng: np.random.Generator) -> None:
    views, reported = capture(rng, turn_rad=0.0, move_mm=0.0)
    error = np.abs(errors(hand_eye(lens("reg"), views, reported)))
    assert error[[0, 1, 2, 6, 7, 8]].max() < 1e-4 and error[[3, 4, 5, 9, 10, 11]].max() < 0.1


def test_images_of_other_poses_are_left_out_and_named(rng: np.random.Generator) -> None:
    views, reported = capture(rng)
    reported[3], reported[7] = reported[7], reported[3]
    result = hand_eye(lens("reg"), views, reported)
    assert set(result.left_out) == {views[3].image, views[7].image}
    assert np.abs(errors(result)[3:6]).max() < 2.0


@pytest.mark.parametrize("board_on_hand", [False, True], ids=["camera", "board"])
@pytest.mark.parametrize(("turn_rad", "move_mm"), [(0.0, 5.0), (8e-3, 0.0)], ids=["moved", "turned"])
def test_a_wrong_robot_pose_is_left_out_and_named(
    turn_rad: float, move_mm: float, board_on_hand: bool, rng: np.random.Generator
) -> None:
    views, reported = capture(rng, 8, board_on_hand=board_on_hand)
    off = Rigid3(exp_so3(turn_rad * np.array([0.6, 0.8, 0.0])), move_mm * np.array([0.6, 0.0, 0.8]))
    reported[2] = reported[2] @ off if board_on_hand else off @ reported[2]
    result = hand_eye(lens("reg"), views, reported, board_on_hand=board_on_hand)
    assert list(result.contradicting) == [views[2].image] and not result.left_out
    assert len(result.image_rms_px) == len(result.translation_residuals_mm) == 7
    turned, moved = result.contradicting[views[2].image]
    # Its own noise, of up to three sigmas about and along each axis, and what the others leave unknown.
    assert turned == pytest.approx(turn_rad, abs=1e-3) and moved == pytest.approx(move_mm, abs=0.7)
    # The noise is that of the others, which 15 numbers show.
    assert result.robot_turn_rad < 1.8 * ROBOT_TURN_RAD and result.robot_move_mm < 1.8 * ROBOT_MOVE_MM
    assert np.abs(errors(result)[[3, 4, 5, 9, 10, 11]]).max() < 0.6


def test_what_cannot_be_solved_is_said(rng: np.random.Generator) -> None:
    views, reported = capture(rng)
    with pytest.raises(InputError, match="same order"):
        hand_eye(lens("reg"), views, reported[1:] + reported[:1])
    with pytest.raises(InputError, match="inverse robot poses"):
        hand_eye(lens("reg"), views, [pose.inverse() for pose in reported])
    with pytest.raises(InputError, match="14 poses"):
        hand_eye(lens("reg"), views, reported[:14])
    with pytest.raises(DegenerateError, match="at least 3"):
        hand_eye(lens("reg"), views[:2], reported[:2])
    about_z = [Rigid3(exp_so3(np.array([0.0, 0.0, 0.1 * k])), [0.0, 0.0, 600.0]) for k in range(8)]
    flat = []
    for k, pose in enumerate(about_z):
        seen, _ = lens("reg").project(pose.apply(views[0].points() - views[0].points().mean(axis=0)))
        flat.append(BoardView(f"{k}.png", views[0].board, views[0].grid, seen, views[0].sigma_px))
    centred = [Rigid3(p.rotation, p.translation_mm - p.rotation @ views[0].points().mean(axis=0)) for p in about_z]
    with pytest.raises(DegenerateError, match="one axis"):
        hand_eye(lens("reg"), flat, [X.inverse() @ p @ Z.inverse() for p in centred])


def test_a_second_axis_counts_by_how_certain_it_makes_the_place(rng: np.random.Generator) -> None:
    """Turns mostly about one axis, four degrees about others: the place is known, less well, and its sigma says so."""
    ratios, sigmas = [], []
    camera = lens("reg")
    middle = random_views(camera, 1, rng, reach_deg=10.0, noise_px=0.1)[0][0].board.points().mean(axis=0)
    for _ in range(8):
        views, reported = [], []
        for k in range(15):
            turn = exp_so3(np.radians([*rng.normal(0.0, 2.5, 2), 0.0])) @ exp_so3(np.array([0.0, 0.0, 0.2 * k]))
            place = np.array([*rng.uniform(-60.0, 60.0, 2), rng.uniform(600.0, 800.0)])
            pose = Rigid3(turn, place - turn @ middle)
            board = random_views(camera, 1, rng, reach_deg=10.0, noise_px=0.1)[0][0].board
            views.append(noisy_view(camera, pose, f"{k}.png", rng, 0.1, board=board))
            true = X.inverse() @ pose @ Z.inverse()
            reported.append(Rigid3(exp_so3(rng.normal(0.0, ROBOT_TURN_RAD, 3)) @ true.rotation, true.translation_mm))
        result = hand_eye(camera, views, reported)
        ratios.append(errors(result) / np.sqrt(np.diag(result.covariance)))
        sigmas.append(np.linalg.norm(result.sigmas()[1][0]))
    assert MAHALANOBIS[0] < float(np.sqrt(np.mean(np.square(ratios)))) < MAHALANOBIS[1]
    assert 0.2 < np.median(sigmas) < 60.0


def test_a_board_that_looks_the_same_turned_is_refused(tmp_path: Path) -> None:
    """Before any image is looked at: nobody could say which end of it is which."""
    (tmp_path / "a.png").touch()
    poses = tmp_path / "poses.csv"
    poses.write_text("image,x_mm,y_mm,z_mm,qx,qy,qz,qw\na.png,0,0,0,0,0,0,1\n")
    reported = HandEyeOptions(camera=Path("camera.json"), board=Path("circles:9x6x30"))
    with pytest.raises(InputError, match="looks the same turned"):
        calibrate_hand_eye(poses, [tmp_path], reported)


def test_from_rendered_images_on_the_command_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    rng = np.random.default_rng(5)
    (tmp_path / "images").mkdir()
    rows, count = ["image,x_mm,y_mm,z_mm,rx_rad,ry_rad,rz_rad"], 0
    while count < 6:
        spot = np.array([320.0, 240.0]) + rng.uniform(-1.0, 1.0, 2) * np.array([90.0, 60.0])
        placed = place_board(PRINTED, LENS, spot, rng.uniform(26.0, 34.0), 40.0, rng)
        if placed is None or not sees_paper(placed, LENS, (0.0, 0.0), LENS.size_px):
            continue
        optics, photometry = Optics(0.7, supersample=2), Photometry(noise_levels=2.0)
        image = render([placed], LENS, Rigid3.identity(), optics=optics, photometry=photometry, rng=rng)
        cv2.imwrite(str(tmp_path / "images" / f"{count}.png"), image)
        base_from_hand = (X.inverse() @ placed.world_from_board @ Z.inverse()).inverse()
        numbers = [*base_from_hand.translation_mm, *log_so3(base_from_hand.rotation)]
        rows.append(",".join([f"{count}.png", *(repr(float(v)) for v in numbers)]))
        count += 1
    (tmp_path / "poses.csv").write_text("\n".join(rows) + "\n")
    (tmp_path / "board.toml").write_text(board_text(PRINTED, "a board", tmp_path / "board.toml"))
    save_camera(tmp_path / "camera.json", LENS)
    known = ["--camera", str(tmp_path / "camera.json"), "--board", str(tmp_path / "board.toml")]
    out = tmp_path / "hand_eye.json"
    command = ["handeye", str(tmp_path / "poses.csv"), str(tmp_path / "images"), *known]
    assert main([*command, "-o", str(out)]) == 0
    assert "cam_from_hand: rotation vector" in capsys.readouterr().out
    found = json.loads(out.read_text())
    assert main([*command, "--json"]) == 0
    assert json.loads(capsys.readouterr().out) == found
    sigma = np.sqrt(np.diag(found["covariance"]))[3:6]
    assert np.all(np.abs(np.array(found["cam_from_hand"])[:, 3] - X.translation_mm) < 5.0 * sigma + 0.02)
    assert np.linalg.norm(sigma) < 2.0
    assert main([*command, "--inverse"]) == 2
    assert "leave it out if it is given" in capsys.readouterr().err
    name, x_mm, rest = rows[1].split(",", 2)
    (tmp_path / "poses.csv").write_text("\n".join([rows[0], f"{name},{float(x_mm) + 9.0},{rest}", *rows[2:]]) + "\n")
    assert main(command) == 0
    assert f"the robot's pose of '{name}' is wrong by 9." in capsys.readouterr().out
    assert main(["pose", str(tmp_path / "images" / "0.png"), *known]) == 0
    assert "camera centre in the board's frame" in capsys.readouterr().out
    (tmp_path / "poses.csv").write_text("\n".join(rows[:-1]) + "\n")
    assert main(command) == 2
    assert "no pose of image '5.png'" in capsys.readouterr().err
