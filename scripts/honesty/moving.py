"""Errors of rigs, over their sigmas, from boards that move in front of cameras without a common trigger.

Each camera has its own lag, with a small random part in every frame, and may read its image row by row. Errors of
successive frames are correlated, because the board keeps its direction for a while.
"""

from __future__ import annotations

from collections import defaultdict
from itertools import combinations

import numpy as np
from helpers.calibration_scenes import BOARD, SIZE, lens

from rigkit.calibration.rig.calibrate import calibrate_rig
from rigkit.cameras.base import Camera
from rigkit.core.arrays import BoolArray, FloatArray
from rigkit.core.detections import BoardView
from rigkit.core.errors import RigkitError
from rigkit.geometry.rigid3 import Rigid3
from rigkit.geometry.rotation import exp_so3, log_so3

from .sessions import CORNERS_PX, MOUNT, SECOND_CENTRE

FRAMES_PER_S = 6.0
LAG_S, JITTER_S = 0.012, 0.003
"""Up to how much a camera lags (either way), and what its frames scatter by."""
PERIODS_S = (1.5, 6.0)
"""Of the swings that a motion is made of."""
SWINGS = 3
READ_ROUNDS = 3
"""A row says when its corner is seen, and that where it is."""
BASELINES_MM = "baselines, mm"
MIDDLE, REACH = np.array([0.0, 0.0, 600.0, 0.0, 0.0, 0.0]), np.array([60.0, 45.0, 90.0, 0.3, 0.3, 0.6])
"""Of a board's middle (mm) and of its turns (rad), and how far each swings."""
BELOW = Rigid3(exp_so3(np.array([0.15, 0.02, -0.01])), [5.0, -110.0, 12.0])
THIRD_CENTRE = np.array([815.0, 610.0])
CAMERAS = {
    "left": (lens("reg"), Rigid3.identity()),
    "right": (lens("reg", SECOND_CENTRE), MOUNT),
    "below": (lens("reg", THIRD_CENTRE), BELOW),
}


class Motion:
    """A board's pose in the first camera as a function of time."""

    def __init__(self, rng: np.random.Generator) -> None:
        self.rate = 2.0 * np.pi / rng.uniform(*PERIODS_S, (SWINGS, 6))
        self.phase = rng.uniform(0.0, 2.0 * np.pi, (SWINGS, 6))

    def at(self, time_s: float) -> Rigid3:
        place = MIDDLE + REACH * np.sin(self.rate * time_s + self.phase).sum(axis=0)
        turn = exp_so3(place[3:])
        return Rigid3(turn, place[:3] - turn @ BOARD.points().mean(axis=0))


def read_by_rows(
    camera: Camera, mount: Rigid3, motion: Motion, times_s: tuple[float, float], pixels: FloatArray
) -> tuple[FloatArray, BoolArray]:
    """Return where the corners are, and whether, when the rows that show them are read: `times_s` are when the middle
    row is, and how long all take."""
    middle_s, readout_s = times_s
    shown = np.ones(len(pixels), dtype=bool)
    for _ in range(READ_ROUNDS):
        when = middle_s + readout_s * (pixels[:, 1] - 0.5 * (SIZE[1] - 1.0)) / SIZE[1]
        corners = zip(when.tolist(), BOARD.points(), strict=True)
        pixels, shown = camera.project(np.array([(mount @ motion.at(t)).apply(corner) for t, corner in corners]))
    return pixels, shown


def moving_session(
    frames: int, cameras: int, rng: np.random.Generator, readout_s: float = 0.0
) -> dict[str, list[float]]:
    """Return the errors of the baselines, mounts and lags of a rig of so many cameras, in stated sigmas, and those of
    the baselines in mm."""
    chosen = dict(list(CAMERAS.items())[:cameras])
    motion, views = Motion(rng), dict[str, list[tuple[str, BoardView]]]()
    lag = {name: rng.uniform(-LAG_S, LAG_S) for name in chosen}
    for k in range(frames):
        for name, (camera, mount) in chosen.items():
            time_s = k / FRAMES_PER_S + lag[name] + JITTER_S * rng.normal()
            pixels, valid = camera.project((mount @ motion.at(time_s)).apply(BOARD.points()))
            if readout_s:
                pixels, valid = read_by_rows(camera, mount, motion, (time_s, readout_s), pixels)
            seen = valid & camera.on_image(pixels)
            exact = pixels[seen] + CORNERS_PX * rng.normal(size=(int(seen.sum()), 2))
            pixels = np.clip(exact, -0.5, np.array(SIZE) - 0.5)
            view = BoardView(f"{name}{k}.png", BOARD, BOARD.grid()[seen], pixels, np.full(len(pixels), CORNERS_PX))
            if len(pixels) >= BOARD.corner_count / 2:
                views.setdefault(name, []).append((f"{k:03d}", view))
    rig = calibrate_rig(views, dict.fromkeys(chosen, SIZE), model=lens("reg").model, folds=0)
    off, mm, mounts = [], [], list[float]()
    for a, b in combinations(chosen, 2):
        length, sigma = rig.baseline_mm(a, b)
        between = chosen[b][1].inverse().translation_mm - chosen[a][1].inverse().translation_mm
        mm.append(length - float(np.linalg.norm(between)))
        off.append(mm[-1] / sigma)
    for k, found in enumerate(rig.cameras[1:], 1):
        true = chosen[found.name][1]
        turned = log_so3(found.cam_from_rig.rotation @ true.rotation.T)
        moved = found.cam_from_rig.translation_mm - true.translation_mm
        mounts += (np.concatenate([turned, moved]) / rig.sigmas[rig.mount(k)]).tolist()
    first = lag[next(iter(chosen))]
    late = [(own.frames - FRAMES_PER_S * (lag[name] - first)) / own.sigma for name, own in rig.lags.items()]
    read = [(own.frames - FRAMES_PER_S * readout_s) / own.sigma for own in rig.readouts.values()]
    return {"readouts": read, "baselines": off, "mounts": mounts, "lags": late, BASELINES_MM: mm}


def moving_sessions(frames: int, seeds: int, readout_s: float = 0.0) -> dict[tuple[str, str], FloatArray]:
    """Return the errors in stated sigmas of rigs of two and three cameras with so many frames, by quantity; the images
    are read in `readout_s`."""
    errors: dict[tuple[str, str], list[float]] = defaultdict(list)
    for cameras in (2, 3):
        for seed in range(seeds):
            try:
                found = moving_session(frames, cameras, np.random.default_rng([seed, frames, cameras]), readout_s)
            except RigkitError as error:
                print(f"{frames} frames, {cameras} cameras: {error}", flush=True)
                continue
            for what, own in found.items():
                errors[what, f"by {cameras} cameras"] += own
    for (what, seen), own in errors.items():
        if what == BASELINES_MM and own:
            print(f"{frames} frames, {what} {seen}: rms error {np.sqrt(np.mean(np.square(own))):.3f}", flush=True)
    return {key: np.abs(own) for key, own in errors.items() if own and key[0] != BASELINES_MM}
