"""Test the detection of a moving entrance pupil and its sigmas: SIMULATED sessions of a fisheye lens and near boards.

A lens of 185 degrees sees 20 flat boards of 9x6 squares of 12 mm, 70 to 250 mm away, with noise of 0.05 px, or waved
boards (every corner displaced by 0.02 mm). The lens of every third session is central. With --far the boards are ten
times as large and as far away; then a pupil has no effect, and none should be detected.

    python scripts/measure_pupil.py [--seeds 0:60] [--pupil 3.0 -0.3] [--waved] [--far] [--model kannala_brandt]
    python scripts/measure_pupil.py --pairs [--seeds 0:10] [--pupil 3.0 -0.3]
    python scripts/measure_pupil.py --rig [--seeds 0:12] [--pupil 3.0 -0.3]
    python scripts/measure_pupil.py --real FOLDER --board 8x6x32.5 --model scaramuzza

Printed for each session: whether the pupil was detected, errors of its terms and of its shift at 80 degrees over their
sigmas, and the RMS error of the projection at large distances (where boards were, after the best rotation) with the
stated one.

--pairs measures with the session's camera: four pairs, the camera moved by 40 to 80 mm, of three boards 110 to 300 mm
away, with a central calibration, with the far camera of one with a pupil, and with the pupil. --rig: two such lenses
60 mm apart, with 0.8 times the pupil's motion in the second, in 20 frames: errors of the baseline and the lenses, also
over their sigmas. --real uses REAL images of one board. The camera is calibrated from each half of them, and any two
images of the other half are a pair: residuals of its epipolar geometry, and of the triangulated board's shape against
the lattice.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import replace
from itertools import combinations
from pathlib import Path
from typing import NamedTuple

import numpy as np

from rigkit.calibration.calibrate import calibrate
from rigkit.calibration.certainty.coverage import covered_by_boards
from rigkit.calibration.certainty.displaced import uncertain_camera
from rigkit.calibration.certainty.uncertainty import FarProjection, worst_direction
from rigkit.calibration.result import Calibration
from rigkit.calibration.rig.calibrate import calibrate_rig
from rigkit.cameras.compare import best_rotation, grid_pixels
from rigkit.cameras.kannala_brandt import KannalaBrandt
from rigkit.cameras.moving_pupil import NearCamera
from rigkit.core.arrays import FloatArray, Points
from rigkit.core.boards import Board
from rigkit.core.detections import BoardDetection, BoardView
from rigkit.core.errors import RigkitError
from rigkit.detection.detect import detect_boards
from rigkit.geometry.rigid3 import Rigid3
from rigkit.geometry.rotation import exp_so3, nearest_rotation
from rigkit.io.media.images import read_image, to_grey
from rigkit.reconstruction.calibration_shifts import calibration_shifts, with_calibrations
from rigkit.reconstruction.geometry import pair_geometry
from rigkit.reconstruction.pairing import match_pair
from rigkit.reconstruction.reconstruct import fit_planes, reconstruct_from

SIZE = (1624, 1240)
TRUTH = KannalaBrandt(SIZE, np.array([371.6, 371.2, 808.0, 615.0, 0.012, -0.006, 0.001, -2e-4]))
SQUARE_MM, NEAREST_MM, FARTHEST_MM, REACH_DEG = 12.0, 90.0, 230.0, 88.0
VIEWS, NOISE_PX, WAVES_MM, AT_DEG = 20, 0.05, 0.02, 80.0
BOARD = Board("near", 9, 6, SQUARE_MM, SQUARE_MM)


class Seen(NamedTuple):
    """A camera of a pair: where it is, the boards before the first one, and their corners in its image."""

    cam_from_first: Rigid3
    poses: Sequence[Rigid3]
    pixels: Sequence[FloatArray]


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


def near_boards(
    near: Sequence[NearCamera], poses: Sequence[Rigid3], rng: np.random.Generator, nearest: float, reach_deg: float
) -> tuple[Rigid3, list[FloatArray | None]]:
    """Return the pose of a board before the first camera, and its corners in each; None where one sees but a part."""
    points = BOARD.points()
    angle, about = np.radians(reach_deg) * np.sqrt(rng.random()), rng.uniform(-np.pi, np.pi)
    facing = exp_so3(angle * np.array([-np.sin(about), np.cos(about), 0.0]))
    rotation = facing @ exp_so3(rng.normal(size=3) * [0.4, 0.4, 1.5])
    centre = rng.uniform(nearest, 1.3 * FARTHEST_MM) * facing[:, 2]
    pose = Rigid3(rotation, centre - rotation @ points.mean(axis=0))
    out: list[FloatArray | None] = []
    for camera, cam_from_first in zip(near, poses, strict=True):
        pixels, valid = camera.project((cam_from_first @ pose).apply(points))
        whole = bool(valid.all()) and bool(camera.lens.on_image(pixels).all())
        noisy = pixels + NOISE_PX * rng.normal(size=pixels.shape)
        out.append(np.clip(noisy, -0.5, np.array(SIZE) - 0.5) if whole else None)
    return pose, out


def measured_pair(found: Calibration, near: bool, boards: Sequence[Board], seen: Sequence[Seen]) -> list[FloatArray]:
    """Return errors and errors over sigmas, (n, 2) each: of the baseline, mm, of points, mm, and of angles between the
    boards' lattice planes, deg."""
    camera, known = found.near if near else found.camera, uncertain_camera(found, near=near)
    first, second = (
        [
            BoardDetection(b.board_id, *b.size, b.grid(), p, np.full(len(p), NOISE_PX))
            for b, p in zip(boards, one, strict=True)
        ]
        for one in (seen[0].pixels, seen[1].pixels)
    )
    geometry = pair_geometry(match_pair("pair", camera, camera, first, second, boards), pose_type="general")
    free = reconstruct_from(geometry)
    shifts = calibration_shifts(free, known)
    cloud = with_calibrations(free, shifts).cloud
    true_mm = float(np.linalg.norm(seen[1].cam_from_first.translation_mm))
    off = free.baseline_mm - true_mm
    sigma = np.hypot(free.baseline_sigma_mm, np.sqrt(shifts.variance(lambda r: r.baseline_mm)))
    by_id = dict(zip((b.board_id for b in boards), seen[0].poses, strict=True))
    ids = [b.board_id for b in geometry.pair.boards]
    truth = np.array(
        [by_id[ids[b]].apply(BOARD.points(g[None]))[0] for b, g in zip(cloud.board_index, cloud.grid, strict=True)]
    )
    away = np.linalg.norm(cloud.points_mm - truth, axis=1)
    planes = fit_planes(geometry, "lattice", known, one_camera=True)
    angles = []
    for a, b in combinations(ids, 2):
        value, stated = planes.angle_deg(a, b)
        cosine = by_id[a].rotation[:, 2] @ by_id[b].rotation[:, 2]
        error = value - 180.0 + float(np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0))))
        angles.append((error, error / stated))
    return [np.array([(off, off / sigma)]), np.stack([away, away / cloud.sigma_mm], axis=1), np.array(angles)]


def pairs(seeds: range, pupil: FloatArray, model: str) -> None:
    """Print what pairs of one camera measure near by, with its pupil and without."""
    true, boards = NearCamera.of(TRUTH, pupil), [replace(BOARD, board_id=f"board {k}") for k in range(3)]
    found: dict[str, list[list[FloatArray]]] = {"central": [], "far camera of the pupil's": [], "with the pupil": []}
    for seed in seeds:
        rng = np.random.default_rng(seed)
        views = drawn_session(pupil, 1.0, 0.0, rng)
        central, moving = (calibrate(views, SIZE, model=model, pupil=one) for one in ("central", "auto"))
        for _ in range(4):
            baseline = [rng.uniform(40.0, 80.0), *rng.normal(size=2) * 10.0]
            poses = [Rigid3.identity(), Rigid3(exp_so3(0.1 * rng.normal(size=3)), baseline)]
            shown: list[tuple[Rigid3, list[FloatArray]]] = []
            while len(shown) < len(boards):
                pose, pixels = near_boards([true, true], poses, rng, 110.0, 60.0)
                whole = [p for p in pixels if p is not None]
                shown += [(pose, whole)] if len(whole) == len(poses) else []
            seen = [Seen(poses[c], [pose for pose, _ in shown], [both[c] for _, both in shown]) for c in (0, 1)]
            for name, one, near in zip(found, (central, moving, moving), (False, False, True), strict=True):
                found[name].append(measured_pair(one, near, boards, seen))
    for name, each in found.items():
        for what, columns in zip(
            ("baseline, mm", "points, mm", "lattice angles, deg"), zip(*each, strict=True), strict=True
        ):
            print(f"SIMULATED pairs, {name}, {what}: {in_words(np.concatenate(columns))}")


def real_pairs(folder: Path, size: str, model: str) -> None:
    """Print how pairs of REAL images of one board, calibrated by the other half of the images, fit epipolar geometry
    and the board's lattice, with the pupil and as a central camera."""
    columns, rows, square = size.split("x")
    board = Board("board", int(columns), int(rows), float(square), float(square))
    views, size_px = [], (0, 0)
    for path in sorted(p for p in folder.iterdir() if p.suffix.lower() in (".jpg", ".png", ".bmp")):
        image = to_grey(read_image(path))
        seen = [d for d in detect_boards(image, [board]) if {d.columns, d.rows} == set(board.size)]
        if len(seen) == 1:
            views.append(BoardView(path.name, board, seen[0].grid, seen[0].pixels, seen[0].sigma_px))
            size_px = (image.shape[1], image.shape[0])
    fits: dict[str, list[tuple[float, float]]] = {"central": [], "auto": []}
    for half in (0, 1):
        cameras = [calibrate(views[half::2], size_px, model=model, pupil=pupil).near for pupil in fits]
        print(folder.name, f"{len(views)} images, half {half}:", getattr(cameras[1], "pupil", "no pupil"), flush=True)
        for pair in combinations(views[1 - half :: 2], 2):
            one, two = ([BoardDetection("board", *board.size, v.grid, v.pixels, v.sigma_px)] for v in pair)
            try:
                found = [
                    pair_geometry(match_pair("pair", c, c, one, two, [board]), pose_type="general") for c in cameras
                ]
            except RigkitError:
                continue
            for name, geometry in zip(fits, found, strict=True):
                points, true = geometry.points.points, board.points(geometry.pair.captured.grid)
                points, true = (
                    p[geometry.points.valid] - p[geometry.points.valid].mean(axis=0) for p in (points, true)
                )
                off = points - true @ nearest_rotation(points.T @ true).T
                fits[name].append((geometry.refined.sampson_rms_px, float(np.sqrt((off**2).sum(axis=1).mean()))))
    central, moving = (np.array(one) for one in fits.values())
    for name, each in fits.items():
        px, mm = np.median(each, axis=0)
        print(
            f"REAL, {folder.name}, {name}: {len(each)} pairs, Sampson {px:.4f} px, board's shape {mm:.3f} mm (medians)"
        )
    px, mm = 100.0 * (moving < central).mean(axis=0)
    print(f"REAL, {folder.name}: smaller with the pupil in {px:.0f} % (Sampson) and {mm:.0f} % (shape) of the pairs")


def rigs(seeds: range, pupil: FloatArray, model: str) -> None:
    """Print baselines, lenses and pupils of rigs whose pupils move, as found with them and without."""
    lenses = {"left": NearCamera.of(TRUTH, pupil), "right": NearCamera.of(TRUTH, 0.8 * pupil)}
    mounts = [Rigid3.identity(), Rigid3(exp_so3(np.array([0.02, -0.05, 0.03])), [-60.0, 2.0, 3.0])]
    found: dict[str, list[list[tuple[float, float]]]] = {"central": [], "auto": []}
    terms: list[FloatArray] = []
    for seed in seeds:
        rng = np.random.default_rng(seed)
        views: dict[str, list[tuple[str, BoardView]]] = {name: [] for name in lenses}
        for frame in range(VIEWS):
            pixels: list[FloatArray | None] = [None]
            while all(p is None for p in pixels):
                _, pixels = near_boards(list(lenses.values()), mounts, rng, NEAREST_MM, 75.0)
            for name, p in zip(lenses, pixels, strict=True):
                if p is not None:
                    view = BoardView(f"{name} {frame}", BOARD, BOARD.grid(), p, np.full(len(p), NOISE_PX))
                    views[name].append((f"{frame:03d}", view))
        for asked, rows in found.items():
            rig = calibrate_rig(views, dict.fromkeys(lenses, SIZE), model=model, pupil=asked)
            length, sigma = rig.baseline_mm("left", "right")
            off = length - float(np.linalg.norm(mounts[1].translation_mm))
            far = [far_errors(camera.calibration) for camera in rig.cameras]
            rows.append([(off, off / sigma), *((error, error / stated) for error, stated in far)])
            for name, solved in rig.pupils.items():
                wrong = solved.terms - lenses[name].pupil
                terms.append(np.stack([wrong, wrong / (rig.widening * np.sqrt(np.diag(solved.covariance)))], axis=1))
            print(seed, asked, f"held-out {rig.heldout_rms_px:.3f} px", np.round(rows[-1], 3).tolist(), flush=True)
    for asked, rows in found.items():
        for k, what in enumerate(("baseline, mm", "left lens far away, px", "right lens far away, px")):
            print(f"SIMULATED rigs, {asked}, {what}: {in_words(np.array(rows)[:, k])}")
    for k, what in enumerate(("e1, mm rad^-2", "e2, mm rad^-4")):
        print(f"SIMULATED rigs, pupils, {what}: {in_words(np.array(terms)[:, k])}")


def in_words(errors: FloatArray) -> str:
    """Return what errors and errors over sigmas (n, 2) come to."""
    (rms, over), part = np.sqrt((errors**2).mean(axis=0)), np.abs(errors[:, 1])
    within = [100.0 * float((part <= k).mean()) for k in (1, 2)]
    return f"rms {rms:.4f}, over sigma {over:.2f}, within one {within[0]:.0f} %, two {within[1]:.0f} % of {len(part)}"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", default="0:60")
    parser.add_argument("--pupil", nargs=2, type=float, default=(3.0, -0.3), metavar=("E1", "E2"))
    parser.add_argument("--waved", action="store_true")
    parser.add_argument("--far", action="store_true")
    parser.add_argument("--model", default="kannala_brandt")
    parser.add_argument("--pairs", action="store_true")
    parser.add_argument("--rig", action="store_true")
    parser.add_argument("--real", type=Path, metavar="FOLDER")
    parser.add_argument("--board", metavar="COLUMNSxROWSxMM")
    args = parser.parse_args()
    seeds = range(*map(int, args.seeds.split(":")))
    if args.real:
        real_pairs(args.real, args.board, args.model)
    elif args.pairs or args.rig:
        (pairs if args.pairs else rigs)(seeds, np.array(args.pupil), args.model)
    else:
        single_cameras(args, seeds)


def single_cameras(args: argparse.Namespace, seeds: range) -> None:
    """Print whether pupils are found, and whether their sigmas are true."""
    terms, off, before, found_of, angle = [], [], [], {True: 0, False: 0}, np.radians(AT_DEG)
    total = {True: 0, False: 0}
    for seed in seeds:
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
            print(seed, "moves" if moves else "central", found.pupil and found.pupil.terms, flush=True)
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
