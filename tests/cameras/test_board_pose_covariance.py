"""The uncertainty of a board's pose includes those of the lens and of the board's shape."""

from __future__ import annotations

import numpy as np
import pytest
from helpers.calibration_scenes import lens

from rigkit.calibration.solving.shape import warp_of_board
from rigkit.cameras.board_pose import pose_covariance_of_lens
from rigkit.core.boards import Board
from rigkit.geometry.board_pose import board_pose
from rigkit.geometry.rigid3 import Rigid3
from rigkit.geometry.rotation import exp_so3, log_so3

BOARD = Board("b", 9, 6, 30.0, 30.0)
POSE = Rigid3(exp_so3(np.array([0.3, -0.4, 0.2])), [-150.0, -60.0, 420.0])
RELATIVE = 0.02
"""The shift is taken to first order, of a change of the lens by less than a pixel; the pose's own fit weighs angles."""

OF_BOARDS = 0.1
"""As a part of the largest turn: a warp leaves residuals that differ from corner to corner, and a fit of angles weighs
them otherwise than one of pixels."""


@pytest.mark.parametrize("name", ["reg", "fish"])
def test_a_changed_lens_moves_the_pose_as_the_covariance_predicts(name: str) -> None:
    camera = lens(name)
    sigma_px = np.full(BOARD.corner_count, 0.05)
    in_cam = POSE.apply(BOARD.points())
    pixels, _ = camera.project(in_cam)
    for k, value in enumerate(camera.parameters):
        step = np.zeros(camera.parameters.size)
        step[k] = 1e-5 * max(abs(value), 1e-9)
        changed = camera.with_parameters(camera.parameters + step)
        rays, _ = changed.unproject(pixels)
        unit = np.linalg.norm(changed.ray_jacobian(pixels), axis=(1, 2)) / np.sqrt(2.0)
        found = board_pose(rays, BOARD.points(), sigma_px * unit).cam_from_board
        turned = log_so3(found.rotation @ POSE.rotation.T)
        moved = np.concatenate([turned, found.translation_mm - POSE.translation_mm])
        covariance = np.outer(step, step)
        printed = pose_covariance_of_lens(camera, covariance, in_cam, POSE.translation_mm, sigma_px)
        if np.abs(moved[3:]).max() > 1e-6:
            np.testing.assert_allclose(
                np.sqrt(np.diag(printed)), np.abs(moved), rtol=RELATIVE, atol=RELATIVE * np.abs(moved).max()
            )


def test_a_warped_board_moves_the_pose_as_the_covariance_predicts() -> None:
    camera, sigma_px = lens("reg"), np.full(BOARD.corner_count, 0.05)
    in_cam, basis = POSE.apply(BOARD.points()), warp_of_board(BOARD.points()).basis
    p, unknowns = camera.parameters.size, basis.shape[-1]
    for k in range(unknowns):
        step = np.zeros(p + unknowns)
        step[p + k] = 1e-4 if k < 2 else 0.02
        pixels, _ = camera.project(POSE.apply(BOARD.points() + basis @ step[p:]))
        rays, _ = camera.unproject(pixels)
        unit = np.linalg.norm(camera.ray_jacobian(pixels), axis=(1, 2)) / np.sqrt(2.0)
        found = board_pose(rays, BOARD.points(), sigma_px * unit).cam_from_board
        moved = np.concatenate([log_so3(found.rotation @ POSE.rotation.T), found.translation_mm - POSE.translation_mm])
        stated = pose_covariance_of_lens(
            camera, np.outer(step, step), in_cam, POSE.translation_mm, sigma_px, POSE.rotation @ basis
        )
        assert np.abs(moved[:3]).max() > 1e-6
        largest = np.abs(moved[:3]).max()
        assert np.sqrt(np.diag(stated))[:3] == pytest.approx(np.abs(moved[:3]), abs=OF_BOARDS * largest)
