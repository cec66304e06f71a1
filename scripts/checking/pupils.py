"""`rigkit check` on simulated lenses whose entrance pupils move: see `bench_check.py`."""

from __future__ import annotations

import numpy as np
from measure_pupil import BOARD, NEAREST_MM, NOISE_PX, SIZE, TRUTH, drawn_session, near_boards

from checking.tally import CHANGED_PX, FRESH, checked, tell
from rigkit.calibration.calibrate import calibrate
from rigkit.cameras.moving_pupil import NearCamera
from rigkit.core.detections import BoardView
from rigkit.geometry.rigid3 import Rigid3
from rigkit.planning.goal import projection_goal
from rigkit.validation.monitoring.verdict import CalibrationCheck

PUPIL, REACH_DEG = (3.0, -0.3), 80.0


def pupils(seeds: int) -> None:
    """Cameras unchanged, and with a focal length that changed so far that 0.15 px rms are left after the best turn."""
    found: dict[str, list[CalibrationCheck]] = {"nothing": [], "focus": []}
    step = np.where(np.arange(TRUTH.parameters.size) < 2, TRUTH.parameters, 0.0)
    step *= CHANGED_PX / np.sqrt(step @ projection_goal(TRUTH).weight @ step)
    for seed in range(seeds):
        rng = np.random.default_rng([seed, 29])
        known = calibrate(drawn_session(np.array(PUPIL), 1.0, 0.0, rng), SIZE, model=TRUTH.model, board="flat", folds=0)
        for what, checks in found.items():
            change = step * rng.choice([-1.0, 1.0]) if what == "focus" else 0.0
            lens = NearCamera.of(TRUTH.with_parameters(TRUTH.parameters + change), PUPIL)
            views: list[BoardView] = []
            while len(views) < FRESH:
                _, (pixels,) = near_boards([lens], [Rigid3.identity()], rng, NEAREST_MM, REACH_DEG)
                if pixels is not None:
                    sigma = np.full(len(pixels), NOISE_PX)
                    views.append(BoardView(f"{len(views)}", BOARD, BOARD.grid(), pixels, sigma))
            checks.append(checked(known, views))
    for what, checks in found.items():
        tell(f"moving pupil: {what}", checks, what)
