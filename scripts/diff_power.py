"""Measure the false alarms and the power of `rigkit diff` on SIMULATED sessions of 20 images.

For every lens (60, 110, 185 degrees) and kind of error, one camera is calibrated from two sessions, and from another
one after the lens was changed. Errors are independent for each corner, or also have a smooth displacement common to an
image, in five modes, as by blur, light or a bending board. Printed are also the differences for an unchanged camera
over the predicted, and the upper bounds of the power for a longer focal length: of the most powerful test (Cramér-Rao),
and of least squares with exactly known covariance.

    python scripts/diff_power.py [--seeds 20] [--lenses reg,wide,fish]
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))
sys.path.insert(0, str(Path(__file__).resolve().parent))

from halves.power import shift_px
from helpers.calibration_scenes import BOARD, REACH_DEG, SIZE, lens, random_views
from helpers.focal_bounds import best_powers

from rigkit.calibration.calibrate import calibrate
from rigkit.calibration.compare import CalibrationComparison, CameraVerdict, compare_calibrations
from rigkit.calibration.result import Calibration
from rigkit.cameras.base import Camera
from rigkit.cameras.compare import grid_pixels

IMAGES = 20
CORNERS_PX = 0.05
COMMON_PX = (0.0, 0.03, 0.05, 0.15)
REMAINING_PX = 0.2
"""What a moved principal point leaves after the best rotation."""


def touched(name: str) -> dict[str, Camera]:
    """Return a lens as it is, and after what may happen to it."""
    camera = lens(name)
    pixels = grid_pixels(SIZE, (24, 18)).reshape(-1, 2)
    rays, valid = camera.unproject(pixels)
    inside = valid & (rays[:, 2] > np.cos(np.radians(REACH_DEG[name])))
    shift = shift_px(camera, pixels[inside], REMAINING_PX)
    zoom, other = np.ones(camera.parameters.size), np.zeros(camera.parameters.size)
    zoom[:2] = 1.001
    moved = np.zeros_like(other)
    moved[2:4] = shift
    # Another unit of the same kind: four per mille of focal length, some pixels of centre, a little of distortion.
    other[:5] = (*(0.004 * camera.parameters[:2]), 6.0, -4.0, 0.003)
    return {
        "the same": camera,
        "focal length + 0.1 %": camera.with_parameters(camera.parameters * zoom),
        "principal point moved": camera.with_parameters(camera.parameters + moved),
        "another unit": camera.with_parameters(camera.parameters + other),
    }


def calibrated(camera: Camera, name: str, common_px: float, seed: tuple[int, ...]) -> Calibration:
    """Return the calibration of a simulated session."""
    rng = np.random.default_rng(seed)
    views, _, _ = random_views(camera, IMAGES, rng, reach_deg=REACH_DEG[name], noise_px=0.0)
    x, y = (BOARD.grid() / (np.array(BOARD.size) - 1.0) * 2.0 - 1.0).T
    modes = np.stack([x * x, x * y, y * y, x * x * y, x * y * y], axis=-1)
    noisy = []
    for view in views:
        error = common_px * modes @ rng.normal(size=(5, 2)) + CORNERS_PX * rng.normal(size=view.pixels.shape)
        inside = np.clip(view.pixels + error, -0.5, np.array(SIZE) - 0.5)
        noisy.append(replace(view, pixels=inside, sigma_px=np.full(len(inside), CORNERS_PX)))
    return calibrate(noisy, SIZE, model=camera.model, board="flat", folds=0)


def compared(name: str, common_px: float, seeds: int) -> Iterator[tuple[str, CalibrationComparison]]:
    """Yield what was done to the lens, and what diff says, for every seed."""
    for seed in range(seeds):
        first = calibrated(lens(name), name, common_px, (seed, 0))
        for what, camera in touched(name).items():
            yield what, compare_calibrations(first, calibrated(camera, name, common_px, (seed, 1)))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--lenses", default="reg,wide,fish")
    args = parser.parse_args()
    ratios, alarms = [], []
    for name in args.lenses.split(","):
        for common_px in COMMON_PX:
            found: dict[str, list[CalibrationComparison]] = {}
            for what, one in compared(name, common_px, args.seeds):
                found.setdefault(what, []).append(one)
            same = found["the same"]
            reported = ", ".join(
                f"{what} {sum(c.verdict is CameraVerdict.OTHER for c in own)} of {len(own)}"
                for what, own in found.items()
            )
            ratio = np.array([c.ratio for c in same])
            usual_px = float(np.median([c.predicted_px for c in same]))
            ratios += ratio.tolist()
            alarms += [c.chance for c in same]
            print(
                f"{name}, {common_px} px in common of an image: expected {usual_px:.3f} px, "
                f"found over expected {np.exp(np.log(ratio).mean()):.2f} (geometric mean); alarms: {reported}",
                flush=True,
            )
    for common_px in COMMON_PX:
        powers = [best_powers(name, CORNERS_PX, common_px) for name in args.lenses.split(",")]
        best, least_squares = np.mean(powers, axis=0).tolist()
        print(
            f"{common_px} px in common: focal length + 0.1 % is found by the most powerful test in {100 * best:.0f} %, "
            f"by least squares with its covariance known in {100 * least_squares:.0f} %"
        )
    share = ", ".join(f"{np.mean(np.array(alarms) < p):.3f} below {p}" for p in (0.01, 0.05, 0.2, 0.5))
    print(f"one camera, {len(alarms)} times: found over expected {np.exp(np.log(ratios).mean()):.3f}; chances: {share}")


if __name__ == "__main__":
    main()
