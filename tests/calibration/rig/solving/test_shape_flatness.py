"""Boards assumed flat that are not: an error common to all frames, which their scatter does not show."""

from __future__ import annotations

import numpy as np
import pytest
from helpers.calibration_scenes import BOARD
from helpers.rig_scenes import MODELS, Views, mounts, rig_views, sizes

from rigkit.calibration.rig.calibrate import calibrate_rig
from rigkit.calibration.rig.result import RigCalibration
from rigkit.calibration.rig.solving.shape import shape_error
from rigkit.calibration.rig.solving.state import RigObservations, RigState
from rigkit.core.arrays import FloatArray

FRAMES = 14
PREDICTED = 0.3
"""The one step is linear; and the noise of 14 frames moves the baseline by a tenth of what the bow does."""


def bow(height_mm: float) -> FloatArray:
    away = (2.0 * (BOARD.points() - BOARD.points().mean(axis=0)) / [240.0, 150.0, 1.0])[:, 0]
    return np.stack([0.0 * away, 0.0 * away, height_mm * (1.0 - away**2)], axis=-1)


def two(rng: np.random.Generator, bumps_mm: FloatArray | float) -> Views:
    return {n: own for n, own in rig_views(rng, FRAMES, bumps_mm=bumps_mm).items() if n != "fish"}


def baseline_off(rig: RigCalibration) -> tuple[float, float]:
    length, sigma = rig.baseline_mm("reg", "wide")
    return length - float(np.linalg.norm(mounts()["wide"][1].translation_mm)), sigma


@pytest.fixture
def found(monkeypatch: pytest.MonkeyPatch) -> list[FloatArray]:
    """Return what `shape_error` has returned so far."""
    out: list[FloatArray] = []

    def recorded(observations: RigObservations, state: RigState, sigma_px: float) -> FloatArray:
        out.append(shape_error(observations, state, sigma_px))
        return out[-1]

    monkeypatch.setattr("rigkit.calibration.rig.assemble.shape_error", recorded)
    return out


def test_flat_boards_add_no_uncertainty(found: list[FloatArray]) -> None:
    for seed in range(6):
        calibrate_rig(two(np.random.default_rng(seed), 0.0), sizes(), model=MODELS, folds=0)
    assert len(found) == 6 and not np.concatenate(found).any()


@pytest.mark.parametrize("height_mm", [1.0, -1.0])
def test_it_is_as_large_as_the_rig_is_off(height_mm: float, found: list[FloatArray]) -> None:
    for seed in range(4):
        views = two(np.random.default_rng(seed), bow(height_mm))
        rig = calibrate_rig(views, sizes(), model=MODELS, folds=0)
        off, sigma = baseline_off(rig)
        mount = rig.cameras[1].cam_from_rig
        centre = mount.rotation.T @ mount.translation_mm
        # The centre is -R^T t: the turn w of the mount moves it by R^T (w x t), the shift by -R^T dt.
        w, dt = found[-1][rig.mount(1)].reshape(2, 3)
        moved = mount.rotation.T @ (np.cross(w, mount.translation_mm) - dt)
        predicted = float(-centre @ moved) / float(np.linalg.norm(centre))
        assert off == pytest.approx(-predicted, rel=PREDICTED)
        assert abs(predicted) < sigma


def test_released_boards_need_none(found: list[FloatArray]) -> None:
    rig = calibrate_rig(two(np.random.default_rng(0), bow(1.0)), sizes(), model=MODELS, board="released", folds=0)
    off, sigma = baseline_off(rig)
    assert not found[-1].any() and abs(off) < 3.0 * sigma
