"""Board poses against exact poses and against OpenCV."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from rigkit.core.boards import Board
from rigkit.core.errors import DegenerateError, InputError
from rigkit.geometry.board_pose import (
    after_pose_step,
    board_pose,
    board_poses,
    moved_board_poses,
    ray_residuals,
    tangent_bases,
)
from rigkit.geometry.rotation import exp_so3, log_so3, rotation_angle, unit

EXACT_ROTATION_RAD = 1e-9
"""Noise-free and well-conditioned; measured 1e-14 over 200 poses."""
EXACT_TRANSLATION_REL = 1e-9
TELEPHOTO_RAD = 1e-6
"""Rounding of the rays, 1e-16, in the 3e-3 by which perspective shows the tilt of a board at 100 m, squared."""
JACOBIAN_REL = 1e-6
"""Central differences with steps of 1e-6 are right to about 1e-9."""
OPENCV_RATIO = 1.02
"""OpenCV's refined IPPE minimises the same error up to second order; over 200 noisy poses the rms agreed to 0.3 %."""

BOARD = Board("a", 8, 6, 50.0, 40.0)


def random_pose(rng: np.random.Generator, *, grazing: float = 0.15) -> tuple[np.ndarray, np.ndarray]:
    """A board anywhere round the camera, in front and behind, from 0.3 to 6 m, not seen edge-on."""
    while True:
        rotation = exp_so3(rng.normal(size=3) * 2.0)
        translation = unit(rng.normal(size=3)) * rng.uniform(300.0, 6000.0)
        x = BOARD.points() @ rotation.T + translation
        if np.abs(unit(x) @ rotation[:, 2]).min() > grazing:
            return rotation, translation


def test_exact_everywhere_round_the_camera(rng: np.random.Generator) -> None:
    behind = 0
    for _ in range(100):
        rotation, translation = random_pose(rng)
        rays = unit(BOARD.points() @ rotation.T + translation)
        pose = board_pose(rays, BOARD.points())
        assert rotation_angle(pose.cam_from_board.rotation @ rotation.T) < EXACT_ROTATION_RAD
        error = np.linalg.norm(pose.cam_from_board.translation_mm - translation)
        assert error < EXACT_TRANSLATION_REL * np.linalg.norm(translation)
        behind += bool((rays[:, 2] < 0.0).all())
    assert behind > 20


def test_rays_that_moved_give_the_poses_that_each_gives_alone(rng: np.random.Generator) -> None:
    checked = 0
    for _ in range(10):
        rotation, translation = random_pose(rng)
        noise = 1e-3 * rng.normal(size=(5, 48, 3))
        rays = unit(unit(BOARD.points() @ rotation.T + translation) + noise)
        alone = [board_pose(f, BOARD.points()) for f in rays]
        together = moved_board_poses(rays, BOARD.points(), alone[0].cam_from_board)
        for one, other in zip(together, alone, strict=True):
            if other.rms_rad < one.rms_rad * (1.0 - 1e-9):
                # From afar both tilts fit: alone, the better one is taken, together the one to start from.
                continue
            assert one.cam_from_board.allclose(other.cam_from_board, rotation_tol=1e-7, translation_tol_mm=1e-3)
            np.testing.assert_allclose(one.covariance, other.covariance, rtol=1e-4, atol=1e-12)
            assert one.rms_rad == pytest.approx(other.rms_rad, rel=1e-9)
            checked += 1
    assert checked >= 45


def test_rays_wider_apart_than_a_right_angle() -> None:
    board = Board("wide", 21, 21, 100.0, 100.0)
    rotation = exp_so3(np.array([0.3, 1.9, 0.2]))
    translation = rotation @ np.array([-300.0, -1500.0, 180.0])
    rays = unit(board.points() @ rotation.T + translation)
    assert (rays @ rays.T).min() < -0.9
    pose = board_pose(rays, board.points()).cam_from_board
    assert rotation_angle(pose.rotation @ rotation.T) < EXACT_ROTATION_RAD


def test_telephoto() -> None:
    """A board that fills a fifth of a degree: conditioning, not the field of view, sets the accuracy."""
    rotation, translation = exp_so3(np.array([0.5, 0.4, 1.0])), np.array([3.0e3, -2.0e3, 1.0e5])
    rays = unit(BOARD.points() @ rotation.T + translation)
    pose = board_pose(rays, BOARD.points()).cam_from_board
    assert rotation_angle(pose.rotation @ rotation.T) < TELEPHOTO_RAD


def test_partial_and_tilted_targets(rng: np.random.Generator) -> None:
    """Any flat target: four corners, and points of a plane that is not z = 0."""
    rotation, translation = random_pose(rng)
    target_from_board = exp_so3(np.array([0.5, -1.0, 2.0]))
    corners = BOARD.points()[[0, 3, 16, 43]]
    for points in (corners, corners @ target_from_board.T + [10.0, -400.0, 70.0]):
        pose = board_pose(unit(points @ rotation.T + translation), points).cam_from_board
        assert rotation_angle(pose.rotation @ rotation.T) < EXACT_ROTATION_RAD
        assert np.abs(pose.apply(points) - (points @ rotation.T + translation)).max() < 1e-6


def test_not_worse_than_opencv_and_covariance_is_right(rng: np.random.Generator) -> None:
    ours, theirs, mahalanobis = [], [], []
    points = BOARD.points() + np.array([100.0, 30.0, 0.0])  # a far origin: turns and shifts are correlated
    focal, sigma_px = 1000.0, 0.5
    for _ in range(200):
        rotation = exp_so3(np.array([0.0, 0.0, rng.uniform(-3, 3)])) @ exp_so3(rng.normal(size=3) * 0.5)
        translation = np.array([*rng.uniform(-300, 300, 2), rng.uniform(800, 1600)])
        x = points @ rotation.T + translation
        if np.abs(unit(x) @ rotation[:, 2]).min() < 0.3:
            continue
        pixels = focal * x[:, :2] / x[:, 2:] + rng.normal(size=(len(x), 2)) * sigma_px
        homogeneous = np.column_stack([pixels / focal, np.ones(len(x))])
        # The mean of the two principal angular sizes of a pixel off axis: cos and cos^2 of the field angle.
        cosine = 1.0 / np.linalg.norm(homogeneous, axis=1)
        pose = board_pose(unit(homogeneous), points, sigma_px / focal * cosine**1.5)
        turn = log_so3(pose.cam_from_board.rotation @ rotation.T)
        error = np.concatenate([turn, pose.cam_from_board.translation_mm - translation])
        mahalanobis.append(error @ np.linalg.solve(pose.covariance, error))
        K = np.diag([focal, focal, 1.0])
        _, rv, tv = cv2.solvePnP(points, pixels, K, None, flags=cv2.SOLVEPNP_IPPE)
        rv, _ = cv2.solvePnPRefineLM(points, pixels, K, None, rv, tv)
        ours.append(np.linalg.norm(turn))
        theirs.append(rotation_angle(cv2.Rodrigues(rv)[0] @ rotation.T))
    assert len(ours) > 150
    rms_ours, rms_theirs = np.sqrt(np.mean(np.square(ours))), np.sqrt(np.mean(np.square(theirs)))
    assert rms_ours < OPENCV_RATIO * rms_theirs
    # 6 degrees of freedom; the mean of n draws has standard deviation sqrt(12 / n): four of them either way.
    assert abs(np.mean(mahalanobis) - 6.0) < 4.0 * np.sqrt(12.0 / len(ours))


def test_covariance_from_residuals_agrees_with_known_noise(rng: np.random.Generator) -> None:
    rotation, translation = random_pose(rng, grazing=0.5)
    rays = unit(unit(BOARD.points() @ rotation.T + translation) + rng.normal(size=(48, 3)) * 1e-4)
    known = board_pose(rays, BOARD.points(), np.full(48, 1e-4)).covariance
    estimated = board_pose(rays, BOARD.points()).covariance
    # 90 degrees of freedom: the variance estimate is within 4 sqrt(2 / 90) = 60 %.
    assert abs(np.trace(estimated) / np.trace(known) - 1.0) < 0.6


def test_both_tilts_of_a_far_board() -> None:
    """From afar the reversed tilt is a second optimum; the better one is the truth."""
    rotation, translation = exp_so3(np.array([0.0, 0.7, 0.0])), np.array([50.0, 20.0, 4000.0])
    rays = unit(BOARD.points() @ rotation.T + translation)
    poses = board_poses(rays, BOARD.points())
    assert len(poses) == 2
    assert rotation_angle(poses[0].cam_from_board.rotation @ rotation.T) < EXACT_ROTATION_RAD
    assert rotation_angle(poses[1].cam_from_board.rotation @ rotation.T) > 1.0
    assert poses[1].rms_rad > poses[0].rms_rad


def test_residual_derivatives(rng: np.random.Generator) -> None:
    rotation, translation = random_pose(rng)
    points = BOARD.points()
    rays = unit(unit(points @ rotation.T + translation) + rng.normal(size=(48, 3)) * 0.2)
    bases = tangent_bases(rays)
    assert np.abs(bases @ np.swapaxes(bases, 1, 2) - np.eye(2)).max() < 1e-12
    assert np.abs(bases @ rays[..., None]).max() < 1e-12
    _, jacobian = ray_residuals(rays, bases, points, rotation, translation)
    for k, h in enumerate([1e-6] * 3 + [1e-3] * 3):
        step = np.zeros(6)
        step[k] = h
        ends = [
            ray_residuals(rays, bases, points, exp_so3(s[:3]) @ rotation, translation + s[3:])[0] for s in (step, -step)
        ]
        difference = (ends[0] - ends[1]) / (2.0 * h)
        assert np.abs(difference - jacobian[..., k]).max() < JACOBIAN_REL * np.abs(jacobian[..., k]).max()


@pytest.mark.parametrize("chosen", [[0, 1, 2], [0, 1, 2, 3, 4], [0, 1, 2, 3, 20]])
def test_degenerate(chosen: list[int]) -> None:
    points = BOARD.points()[chosen]
    with pytest.raises(DegenerateError):
        board_pose(unit(points + np.array([0.0, 0.0, 900.0])), points)


def test_a_bowed_target_has_the_pose_of_its_own_corners(rng: np.random.Generator) -> None:
    """A bow of a fiftieth of the board, far more than cardboard has: a flat model would be wrong by degrees."""
    flat = BOARD.points()
    bow = 8.0 * np.cos(np.linspace(-1.5, 1.5, 48)) * [[0.0], [0.0], [1.0]]
    points = flat + bow.T
    for _ in range(20):
        rotation, translation = random_pose(rng)
        pose = board_pose(unit(points @ rotation.T + translation), points).cam_from_board
        assert rotation_angle(pose.rotation @ rotation.T) < EXACT_ROTATION_RAD
        assert np.linalg.norm(pose.translation_mm - translation) < EXACT_TRANSLATION_REL * np.linalg.norm(translation)


def test_bad_input() -> None:
    points = BOARD.points()
    rays = unit(points + np.array([0.0, 0.0, 900.0]))
    with pytest.raises(InputError, match="plane"):
        board_pose(rays, points + np.arange(48)[:, None] % 2 * [0.0, 0.0, 100.0])
    with pytest.raises(InputError, match="positive"):
        board_pose(rays, points, np.zeros(48))
    with pytest.raises(InputError, match="points_mm"):
        board_pose(rays, points[:5])


def test_a_step_is_that_of_which_residuals_have_their_derivatives(rng: np.random.Generator) -> None:
    """A wrong one only slows a solver down, which takes no step that makes a pose worse."""
    points = np.array([[0.0, 0.0, 0.0], [60.0, 0.0, 0.0], [60.0, 40.0, 0.0], [0.0, 40.0, 0.0], [25.0, 30.0, 0.0]])
    rotation, translation = exp_so3(np.array([[0.3, -0.2, 0.1]])), np.array([[-20.0, -10.0, 300.0]])
    rays = unit(points @ rotation[0].T + translation[0] + rng.normal(0.0, 1.0, (5, 3)))
    bases = tangent_bases(rays)
    _, jacobian = ray_residuals(rays, bases, points, rotation, translation)
    for k, size in enumerate((1e-6, 1e-6, 1e-6, 1e-3, 1e-3, 1e-3)):
        step = size * np.eye(6)[k : k + 1]
        ahead, back = (
            ray_residuals(rays, bases, points, *after_pose_step((rotation, translation), s))[0] for s in (step, -step)
        )
        np.testing.assert_allclose((ahead - back) / (2.0 * size), jacobian[..., k], rtol=1e-6, atol=1e-9)
