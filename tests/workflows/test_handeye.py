"""The pose of a camera relative to a board whose shape its calibration measured."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from helpers.calibration_scenes import lens
from helpers.monitoring_scenes import calibrated_lens

from rigkit.calibration.board_shape import BoardShape
from rigkit.core.boards import Board
from rigkit.core.detections import BoardDetection
from rigkit.geometry.rigid3 import Rigid3
from rigkit.geometry.rotation import exp_so3, rotation_angle
from rigkit.io.calibrations.calibration_file import save_calibration
from rigkit.workflows import handeye

EVEN = Board("even", 8, 6, 30.0, 30.0)
"""Looks the same turned by 180 degrees; its bow does not."""
POSE = Rigid3(exp_so3(np.array([0.4, -0.3, 0.1])), [-90.0, -60.0, 700.0])
NEAR_RAD = 1e-4
"""The calibrated lens is off by some hundredths of a pixel, of 1364 a radian."""


def bowed(board: Board) -> np.ndarray:
    """Return the corners (N, 3) of a board that is bowed by 1 mm, more at its end than at its start."""
    points = board.points()
    x, y = (points[:, :2] / points[:, :2].max(axis=0)).T
    points[:, 2] = 4.0 * x**2 * (1.0 - x) + 1.5 * y * x
    return points


@pytest.mark.parametrize("turns", [0, 2])
def test_pose_uses_the_measured_corners(
    turns: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """Whichever end the detection calls the first; a board of other squares is taken as declared."""
    known = calibrated_lens()
    measured = BoardShape.of(EVEN, "released", bowed(EVEN))
    save_calibration(tmp_path / "lens.json", replace(known, boards=(*known.boards, measured)))
    pixels, _ = lens("reg").project(POSE.apply(bowed(EVEN)))
    seen = BoardDetection("even-as-typed", 8, 6, EVEN.grid(), pixels, np.full(48, 0.05)).turned(turns)
    cv2.imwrite(str(tmp_path / "image.png"), np.zeros(known.camera.size_px[::-1], np.uint8))

    def placed(words: str, name: str) -> handeye.PlacedCamera:
        monkeypatch.setattr(handeye, "detect_boards", lambda *args, **named: (seen.named(name),))
        return handeye.camera_on_board(tmp_path / "image.png", tmp_path / "lens.json", words)

    found = placed("8x6x30", "board-8x6x30")
    assert found.board_measured
    assert rotation_angle(found.pose.cam_from_board.rotation @ POSE.rotation.T) < NEAR_RAD
    other = placed("8x6x31", "board-8x6x31")
    assert not other.board_measured
    assert other.rms_px > 10.0 * found.rms_px
    assert not caplog.records
    assert not placed("6x8x30", "board-6x8x30").board_measured
    assert "a board of 8x6, taken here as flat" in caplog.text
    monkeypatch.setattr(handeye, "larger_grid", lambda *_: "9 x 6 inner corners are seen")
    placed("8x6x30", "board-8x6x30")
    assert "image.png' 9 x 6 inner corners are seen" in caplog.text
