from __future__ import annotations

import numpy as np
import pytest
from helpers.calibration_scenes import lens, noisy_view
from helpers.sentinel_scenes import NOISE_PX, poses_held

from rigkit.calibration.calibrate import calibrate
from rigkit.calibration.result import Calibration


@pytest.fixture(scope="session")
def calibration() -> Calibration:
    """The lens "reg", from boards held well."""
    camera, rng = lens("reg"), np.random.default_rng(2)
    views = [noisy_view(camera, pose, f"{k}", rng, NOISE_PX) for k, pose in enumerate(poses_held("reg", 14))]
    return calibrate(views, camera.size_px, model="brown", degree=5, board="flat")
