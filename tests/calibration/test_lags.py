"""Cameras without a common trigger before a moving board: how far that moves the rig is stated."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from helpers.calibration_scenes import BOARD, SIZE, lens

from rigkit.calibration.rig.calibrate import calibrate_rig
from rigkit.calibration.rig.lags import lag_error
from rigkit.calibration.rig.result import RigCalibration
from rigkit.core.arrays import FloatArray
from rigkit.core.detections import BoardView
from rigkit.geometry.rigid3 import Rigid3
from rigkit.geometry.rotation import exp_so3

MOUNT = Rigid3(exp_so3(np.array([0.01, -0.08, 0.005])), [-120.0, 3.0, 8.0])
FRAMES, NOISE_PX = 12, 0.03
RATES = np.array([[0.9, 0.5, 0.7], [0.4, 1.1, 0.6]])
"""Of turns and shifts about three axes, rad a frame."""


def pose(time: float, seed: int) -> Rigid3:
    """Return where a board in hand is, from one frame's time to the next about 60 mm and 15 degrees further."""
    turns, shifts = np.sin(RATES * time + np.random.default_rng(seed).uniform(0.0, 6.0, (2, 3)))
    turn = exp_so3(turns * [0.4, 0.4, 0.8])
    return Rigid3(turn, shifts * [70.0, 50.0, 120.0] + [0.0, 0.0, 600.0] - turn @ BOARD.points().mean(axis=0))


def rig_of(lag: float, seed: int) -> RigCalibration:
    """Return a rig whose second camera sees all that much of a frame's time later."""
    rng = np.random.default_rng(seed)
    cameras = {"left": (Rigid3.identity(), 0.0), "right": (MOUNT, lag)}
    views: dict[str, list[tuple[str, BoardView]]] = {name: [] for name in cameras}
    for k in range(FRAMES):
        for name, (mount, late) in cameras.items():
            pixels, _ = lens("reg").project((mount @ pose(k + late, seed)).apply(BOARD.points()))
            seen = lens("reg").on_image(pixels)
            noisy = np.clip(pixels[seen] + NOISE_PX * rng.normal(size=(int(seen.sum()), 2)), 0.0, np.array(SIZE) - 1.0)
            view = BoardView(f"{name}{k}", BOARD, BOARD.grid()[seen], noisy, np.full(len(noisy), NOISE_PX))
            views[name].append((str(k), view))
    return calibrate_rig(views, dict.fromkeys(cameras, SIZE), model="brown", folds=0)


@pytest.fixture
def moved(monkeypatch: pytest.MonkeyPatch) -> list[FloatArray]:
    """Return what `lag_error` has returned so far."""
    out = list[FloatArray]()

    def recorded(*given: Any) -> FloatArray:
        out.append(lag_error(*given))
        return out[-1]

    monkeypatch.setattr("rigkit.calibration.rig.assemble.lag_error", recorded)
    return out


def in_sigmas(rig: RigCalibration) -> float:
    length, sigma = rig.baseline_mm("left", "right")
    return (length - float(np.linalg.norm(MOUNT.translation_mm))) / sigma


def test_a_lag_is_in_the_sigmas(moved: list[FloatArray]) -> None:
    off = np.array([in_sigmas(rig_of(0.05, seed)) for seed in range(4)])
    assert all(own.any() for own in moved)
    assert np.sqrt(np.mean(off**2)) < 1.5


def test_cameras_of_one_moment_have_none(moved: list[FloatArray]) -> None:
    off = np.array([in_sigmas(rig_of(0.0, seed)) for seed in range(3)])
    assert not any(own.any() for own in moved)
    assert np.abs(off).max() < 3.0
