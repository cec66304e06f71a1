"""Is a moving entrance pupil found, and are its sigmas true? SIMULATED sessions of a fisheye before near boards.

A lens of 185 degrees sees 20 boards of 9x6 squares of 12 mm, 70 to 250 mm away, flat, with noise of 0.05 px, or boards
that are waved (every corner off by 0.02 mm); every third session's lens looks from one point. With --far the boards are
ten times as large and as far away: there a pupil does nothing, and none is to be found.

    python scripts/measure_pupil.py [--seeds 0:60] [--pupil 3.0 -0.3] [--waved] [--far] [--model kannala_brandt]

Of each session: whether the pupil was found, its terms and its shift at 80 degrees in stated sigmas, and how far the
lens is off the truth far away (rms where boards were, after the best rotation) against what is stated.
"""

from __future__ import annotations

import argparse

import numpy as np

from rigkit.calibration.calibrate import calibrate
from rigkit.calibration.coverage import covered_by_boards
from rigkit.calibration.result import Calibration
from rigkit.calibration.uncertainty import FarProjection, worst_direction
from rigkit.cameras.compare import best_rotation, grid_pixels
from rigkit.cameras.kannala_brandt import KannalaBrandt
from rigkit.core.arrays import FloatArray, Points
from rigkit.core.boards import Board
from rigkit.core.detections import BoardView
from rigkit.geometry.rotation import exp_so3

SIZE = (1624, 1240)
TRUTH = KannalaBrandt(SIZE, np.array([371.6, 371.2, 808.0, 615.0, 0.012, -0.006, 0.001, -2e-4]))
SQUARE_MM, NEAREST_MM, FARTHEST_MM, REACH_DEG = 12.0, 90.0, 230.0, 88.0
VIEWS, NOISE_PX, WAVES_MM, AT_DEG = 20, 0.05, 0.02, 80.0


def before_pupil(points: Points, pupil: FloatArray) -> Points:
    """Return points (N, 3) as from the pupil that sees each, by iteration."""
    seen = points.copy()
    for _ in range(50):
        angle = np.arctan2(np.hypot(seen[:, 0], seen[:, 1]), seen[:, 2])
        seen[:, 2] = points[:, 2] - pupil[0] * angle**2 - pupil[1] * angle**4
    return seen


def drawn_session(pupil: FloatArray, scale: float, waves_mm: float, rng: np.random.Generator) -> list[BoardView]:
    """Return the views of a session."""
    board = Board("near", 9, 6, scale * SQUARE_MM, scale * SQUARE_MM)
    points = board.points() + waves_mm * scale * rng.normal(size=(board.corner_count, 3))
    views: list[BoardView] = []
    while len(views) < VIEWS:
        angle, about, axis, spin = np.radians(REACH_DEG) * np.sqrt(rng.random()), *rng.uniform(-np.pi, np.pi, 3)
        along = np.array([np.sin(angle) * np.cos(about), np.sin(angle) * np.sin(about), np.cos(angle)])
        facing = exp_so3(angle * np.array([-np.sin(about), np.cos(about), 0.0]))
        tilt = np.radians(rng.uniform(10.0, 45.0)) * np.array([np.cos(axis), np.sin(axis), 0.0])
        rotation = facing @ exp_so3(tilt) @ exp_so3(np.array([0.0, 0.0, spin]))
        centre = scale * rng.uniform(NEAREST_MM, FARTHEST_MM) * along - rotation @ board.points().mean(axis=0)
        pixels, valid = TRUTH.project(before_pupil(points @ rotation.T + centre, pupil))
        if not (valid.all() and TRUTH.on_image(pixels).all()):
            continue
        pixels = np.clip(pixels + NOISE_PX * rng.normal(size=pixels.shape), -0.5, np.array(SIZE) - 0.5)
        sigma = np.full(len(pixels), NOISE_PX)
        views.append(BoardView(f"{len(views):03d}", board, board.grid(), pixels, sigma))
    return views


def far_errors(found: Calibration) -> tuple[float, float]:
    """Return the error far away (rms px where boards were) and what is stated for it."""
    pixels = grid_pixels(SIZE, (24, 18)).reshape(-1, 2)
    rays, valid = TRUTH.unproject(pixels)
    inside = valid & covered_by_boards(found, pixels)
    rays, pixels = rays[inside], pixels[inside]
    turn = best_rotation(rays, pixels, np.ones(len(rays)), found.camera)
    error = found.camera.project(rays @ turn.T)[0] - pixels
    stated = worst_direction(FarProjection.of(found).covariance(rays @ turn.T))
    return float(np.sqrt((error**2).sum(axis=1).mean())), float(np.sqrt((stated**2).mean()))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", default="0:60")
    parser.add_argument("--pupil", nargs=2, type=float, default=(3.0, -0.3), metavar=("E1", "E2"))
    parser.add_argument("--waved", action="store_true")
    parser.add_argument("--far", action="store_true")
    parser.add_argument("--model", default="kannala_brandt")
    args = parser.parse_args()
    first, last = map(int, args.seeds.split(":"))
    terms, off, before, found_of, angle = [], [], [], {True: 0, False: 0}, np.radians(AT_DEG)
    total = {True: 0, False: 0}
    for seed in range(first, last):
        moves = seed % 3 != 2
        pupil = np.array(args.pupil if moves else (0.0, 0.0))
        views = drawn_session(
            pupil, 10.0 if args.far else 1.0, WAVES_MM if args.waved else 0.0, np.random.default_rng(seed)
        )
        found = calibrate(views, SIZE, model=args.model)
        total[moves] += 1
        found_of[moves] += found.pupil is not None
        if moves and found.pupil is not None:
            covariance = found.widening**2 * found.pupil.covariance
            shift, sigma = found.pupil.shift_mm(angle)
            true = float(pupil @ [angle**2, angle**4])
            in_sigmas = [*((found.pupil.terms - pupil) / np.sqrt(np.diag(covariance)))]
            terms.append([*in_sigmas, (shift - true) / (found.widening * sigma)])
            off.append(far_errors(found))
            before.append(far_errors(calibrate(views, SIZE, model=args.model, pupil="central")))
            print(seed, np.round(found.pupil.terms, 3), np.round(terms[-1], 2), np.round(off[-1], 4), flush=True)
        else:
            print(seed, "moves" if moves else "one point", found.pupil and found.pupil.terms, flush=True)
    print(f"SIMULATED: found {found_of[True]} of {total[True]} that move, {found_of[False]} of {total[False]} central")
    if not terms:
        return
    for name, column in zip(("e1", "e2", f"shift at {AT_DEG:.0f} degrees"), np.abs(terms).T, strict=True):
        print(f"{name}: {100 * (column <= 1).mean():.0f} % in one sigma, {100 * (column <= 2).mean():.0f} % in two")
    ratio, central = (np.array(one)[:, 0] / np.array(one)[:, 1] for one in (off, before))
    for name, one, errors in (("with the pupil", ratio, off), ("central", central, before)):
        print(
            f"far away, {name}: median error {np.median(errors, axis=0)[0]:.4f} px, stated "
            f"{np.median(errors, axis=0)[1]:.4f}; rms error over stated {np.sqrt((one**2).mean()):.2f}; in one sigma "
            f"{100 * (one <= 1).mean():.0f} %, in two {100 * (one <= 2).mean():.0f} %"
        )


if __name__ == "__main__":
    main()
