"""Compare calibration with OpenCV, mrcal and Ceres on the same SIMULATED corners: time, error, failures.

    python scripts/benchmark_calibration.py [--views 40] [--repeats 15] [--failures 20 [--omnidir 3]]

Times are medians of CPU seconds of one process with one thread, including the initialisation from corners only. All
programs of a table run alternately, so that other load on the machine affects them alike. RMS is 2-D per corner.
"Difference" is the RMS difference of the projection to the true lens over its field after the best rotation, px.

mrcal is Debian's (apt-get install mrcal python3-mrcal).
"""

from __future__ import annotations

import argparse
import os
import statistics
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
os.environ.setdefault("OMP_NUM_THREADS", "1")

import cv2
import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))
from calibrators.peers import (
    Mrcal,
    colmap_adjuster,
    colmap_model,
    colmap_poses,
    opencv_fisheye,
    opencv_multiview,
    opencv_omnidir,
    opencv_regular,
)
from helpers.calibration_scenes import BOARD, REACH_DEG, SIZE, lens, projection_difference, random_views

from rigkit.calibration.calibrate import calibrate
from rigkit.calibration.rig.calibrate import calibrate_rig
from rigkit.calibration.solving.initialise import initialise
from rigkit.calibration.solving.solver import solve
from rigkit.calibration.views.observations import Observations
from rigkit.cameras.base import Camera
from rigkit.cameras.kannala_brandt import KannalaBrandt
from rigkit.core.boards import Board
from rigkit.core.detections import BoardView
from rigkit.core.errors import RigkitError
from rigkit.geometry.rigid3 import Rigid3
from rigkit.geometry.rotation import exp_so3

NOISE_PX = 0.2
LARGE = Board("14x10", 14, 10, 30.0, 30.0)

Run = Callable[[], float]
"""One run of a peer, returning its CPU seconds."""


def clocked(function: Callable[[], object]) -> Run:
    """Return a run of the function in this process."""

    def run() -> float:
        start = time.process_time()
        function()
        return time.process_time() - start

    return run


def timed(runs: Mapping[str, Run], repeats: int) -> dict[str, float]:
    """Return each run's median CPU seconds; they take turns, after one turn that does not count."""
    spent: dict[str, list[float]] = {name: [] for name in runs}
    for turn in range(repeats + 1):
        for name, run in runs.items():
            seconds = run()
            if turn:
                spent[name].append(seconds)
    return {name: statistics.median(seconds) for name, seconds in spent.items()}


def ours(views: list[BoardView], model: str, degree: int | None) -> tuple[float, Camera]:
    result = calibrate(views, SIZE, model=model, degree=degree, board="flat", folds=0)
    return result.rms_px, result.camera


def table(title: str, columns: Sequence[str], rows: Sequence[Sequence[str]]) -> None:
    """Print a table in Markdown."""
    print(f"\n{title}\n")
    for row in (columns, ["---"] * len(columns), *rows):
        print("| " + " | ".join(row) + " |")


def speed(name: str, count: int, board: Board, repeats: int, mrcal: bool) -> None:
    """One lens, ours and every peer that has a model for it."""
    views, _, _ = random_views(lens(name), count, np.random.default_rng(1), reach_deg=REACH_DEG[name], board=board)
    if name == "reg":
        solvers = {
            "rigkit brown 5": lambda: ours(views, "brown", 5),
            "cv2.calibrateCamera": lambda: opencv_regular(views, SIZE),
        }
    else:
        solvers = {
            "rigkit kannala_brandt": lambda: ours(views, "kannala_brandt", None),
            "rigkit scaramuzza 6": lambda: ours(views, "scaramuzza", 6),
            "cv2.fisheye": lambda: opencv_fisheye(views, SIZE),
        }
    first = next(iter(solvers))
    found: dict[str, tuple[float, Camera]] = {}
    rows: list[list[str]] = []
    for solver, solve_once in solvers.items():
        try:
            found[solver] = solve_once()
        except (cv2.error, RigkitError, AssertionError) as failed:
            why = str(failed).split("error: ")[-1].splitlines() or ["no sensible camera"]
            rows.append([solver, "-", "-", "-", f"failed: {why[0][:60]}"])
    runs = {solver: clocked(solvers[solver]) for solver in found}
    if name == "reg" and mrcal:
        with Mrcal({(k, 0): view for k, view in enumerate(views)}, SIZE) as peer:
            spent = timed({**runs, "mrcal OPENCV5": peer.run}, repeats)
            found["mrcal OPENCV5"] = np.sqrt(2.0) * peer.last["rms"], peer.cameras()[0]
    else:
        spent = timed(runs, repeats)
    done = []
    for solver, (rms, camera) in found.items():
        try:
            off = projection_difference(camera, lens(name), 0.95 * REACH_DEG[name])
            difference = f"{np.sqrt((off**2).mean()):.3f}"
        except AssertionError:
            difference = "sees less than the lens"
        ratio = f"{spent[solver] / spent[first]:.2f}"
        done.append([solver, f"{1000 * spent[solver]:.1f}", ratio, f"{rms:.4f}", difference])
    title = f"{name}, {count} views of {board.columns}x{board.rows}, median of {repeats}"
    table(title, ["solver", "CPU ms", "times ours", "RMS px", "difference px"], done + rows)


def ceres(count: int, repeats: int) -> None:
    """The solver alone beside Ceres through pycolmap, from the same start: same cameras, poses and corners."""
    try:
        import pycolmap
    except ImportError:
        print("\nSolver alone: pycolmap is not installed, no comparison with Ceres")
        return
    views, _, _ = random_views(lens("wide"), count, np.random.default_rng(1), reach_deg=REACH_DEG["wide"])
    observations = Observations.from_views(views)
    start = next(initialise(observations, SIZE, KannalaBrandt, None))
    found = solve(observations, start, prior_sigma_px=0.0)
    models: list[Any] = []

    def run() -> float:
        model = colmap_model(pycolmap, views, start)
        models[:] = [model]
        return clocked(colmap_adjuster(pycolmap, model).solve)()

    own = clocked(lambda: solve(observations, start, prior_sigma_px=0.0))
    spent = timed({"rigkit": own, "Ceres": run}, repeats)
    model = models[0]
    camera = model.cameras[1]
    fitted = camera.params - np.array([0.0, 0.0, 0.5, 0.5, 0.0, 0.0, 0.0, 0.0])
    squared = sum(
        float(((camera.img_from_cam(v.points() @ R.T + t) - 0.5 - v.pixels) ** 2).sum())
        for v, (R, t) in zip(views, colmap_poses(model), strict=True)
    )
    cost = float(found.data.costs.sum())
    apart = np.abs(found.state.camera.parameters - fitted)[:2].max()
    print(
        f"\nSolver alone from the same start, kannala_brandt, {count} views of 54: rigkit "
        f"{1000 * spent['rigkit']:.1f} ms, Ceres {1000 * spent['Ceres']:.1f} ms "
        f"({spent['Ceres'] / spent['rigkit']:.1f} times); cost {cost:.8f} and {squared:.8f}, relative difference "
        f"{(cost - squared) / squared:.1e}; focal lengths apart by {apart:.1e} px"
    )


def failures(seeds: int, omnidir: int) -> None:
    """How often each fails: no result, views dropped, or an RMS of more than 1.1 times the noise."""
    cases = [("fish", reach, 20) for reach in (60.0, 75.0, 85.0, 92.5)]
    cases += [("fish200", 100.0, 20), ("fish", 92.5, 5), ("wide", 55.0, 20), ("wide", 55.0, 5)]
    rows = []
    for name, reach, count in cases:
        failed = np.zeros(3, dtype=int)
        slow = 0
        guess = lens(name).parameters
        K = np.array([[1.05 * guess[0], 0.0, guess[2]], [0.0, 1.05 * guess[1], guess[3]], [0.0, 0.0, 1.0]])
        for seed in range(seeds):
            views, _, _ = random_views(lens(name), count, np.random.default_rng(1000 + seed), reach_deg=reach)
            failed += [
                _fails(partial(ours_rms, views)),
                _fails(partial(fisheye_rms, views)),
                _fails(partial(fisheye_rms, views, K)),
            ]
            slow += seed < omnidir and _fails(partial(opencv_omnidir, views, SIZE))
        tried = min(seeds, omnidir)
        rows.append([name, f"{reach:g}", str(count), *(f"{n} of {seeds}" for n in failed), f"{slow} of {tried}"])
    columns = ["lens", "boards out to deg", "views", "rigkit", "cv2.fisheye", "with K 5 % off", "cv2.omnidir"]
    table("Failures (RMS beyond 1.1 times the noise, views dropped, or an exception), no guess", columns, rows)


def ours_rms(views: list[BoardView]) -> float:
    return ours(views, "kannala_brandt", None)[0]


def fisheye_rms(views: list[BoardView], K: np.ndarray | None = None) -> float:
    return opencv_fisheye(views, SIZE, K)[0]


def _fails(run: Callable[[], float]) -> bool:
    try:
        return not run() < 1.1 * NOISE_PX * np.sqrt(2.0)
    except (cv2.error, RigkitError):
        return True


def scale(repeats: int) -> None:
    base, _, _ = random_views(lens("fish"), 250, np.random.default_rng(2), reach_deg=92.5)
    rows = []
    for count in (50, 250, 500, 1000, 2000):
        views = [
            BoardView(f"{k}", v.board, v.grid, v.pixels, v.sigma_px)
            for k, v in enumerate((base * (count // len(base) + 1))[:count])
        ]
        run = clocked(partial(ours, views, "kannala_brandt", None))
        spent = timed({"": run}, max(1, repeats // 3))[""]
        rows.append([str(count), f"{1000 * spent:.1f}", f"{1e6 * spent / count:.1f}"])
    table("Time against the number of views (kannala_brandt, fish)", ["views", "CPU ms", "us a view"], rows)


def rig(frames: int, repeats: int, mrcal: bool) -> None:
    """Four cameras on a bar; mounts against the truth."""
    mounts, views = rig_views(frames)
    sizes = dict.fromkeys(views, SIZE)
    result: list[Any] = [None, None]

    def own() -> None:
        result[0] = calibrate_rig(views, sizes, model="brown", degree=5, folds=0)

    def opencv() -> None:
        result[1] = opencv_multiview(views, SIZE, frames)

    runs = {"rigkit brown 5": clocked(own), "cv2.calibrateMultiview": clocked(opencv)}
    if mrcal:
        by_key = {(int(f), k): view for k, name in enumerate(views) for f, view in views[name]}
        with Mrcal(by_key, SIZE) as peer:
            spent = timed({**runs, "mrcal OPENCV5": peer.run}, repeats)
        theirs = [np.zeros(6), *np.array(peer.last["mounts"])]
    else:
        spent = timed(runs, repeats)
        theirs = []
    found = {
        "rigkit brown 5": ([c.cam_from_rig.translation_mm for c in result[0].cameras], f"{result[0].rms_px:.4f}"),
        "cv2.calibrateMultiview": (result[1], "-"),
    }
    if mrcal:
        found["mrcal OPENCV5"] = [rt[3:] for rt in theirs], f"{np.sqrt(2.0) * peer.last['rms']:.4f}"
    first = spent["rigkit brown 5"]
    rows = []
    for name, (places, rms) in found.items():
        off = max(np.linalg.norm(p - m.translation_mm) for p, m in zip(places, mounts, strict=True))
        rows.append([name, f"{1000 * spent[name]:.1f}", f"{spent[name] / first:.2f}", rms, f"{off:.3f}"])
    count = sum(len(v) for v in views.values())
    columns = ["solver", "CPU ms", "times ours", "RMS px", "worst mount mm"]
    table(f"Rig of 4 cameras, {frames} frames, {count} views of 9x6, median of {repeats}", columns, rows)


def rig_views(frames: int) -> tuple[list[Rigid3], dict[str, list[tuple[str, BoardView]]]]:
    """Return the mounts, and each camera's views by frame."""
    rng = np.random.default_rng(3)
    cameras = [lens("reg")] * 4
    mounts = [Rigid3(exp_so3(0.1 * rng.normal(size=3)), [-100.0 * k, 5.0 * k, 3.0 * k]) for k in range(4)]
    mounts[0] = Rigid3.identity()
    # As ever: the places below follow from the seed.
    board = random_views(lens("reg"), 1, rng, reach_deg=33.0)[0][0].board
    views: dict[str, list[tuple[str, BoardView]]] = {f"c{k}": [] for k in range(4)}
    for f in range(frames):
        turn = exp_so3(rng.normal(size=3) * np.array([0.4, 0.4, 1.5]))
        place = np.array([rng.uniform(-250, 400), rng.uniform(-200, 200), rng.uniform(700, 1100)])
        pose = Rigid3(turn, place - turn @ board.points().mean(axis=0))
        for k, (camera, mount) in enumerate(zip(cameras, mounts, strict=True)):
            pixels, valid = camera.project((mount @ pose).apply(board.points()))
            if valid.all() and camera.on_image(pixels).all():
                noisy = np.clip(pixels + NOISE_PX * rng.normal(size=pixels.shape), 0.0, np.array(SIZE) - 1.0)
                sigma = np.full(len(noisy), NOISE_PX)
                views[f"c{k}"].append((str(f), BoardView(f"c{k}-{f}", board, board.grid(), noisy, sigma)))
    return mounts, views


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--views", type=int, default=40)
    parser.add_argument("--repeats", type=int, default=15)
    parser.add_argument("--failures", type=int, default=0, help="seeds of the failure table")
    parser.add_argument("--omnidir", type=int, default=0, help="on so many of these seeds cv2.omnidir too (minutes)")
    args = parser.parse_args()
    cv2.setNumThreads(1)
    mrcal = Mrcal.available()
    if not mrcal:
        print("mrcal is not installed (apt-get install mrcal python3-mrcal): no comparison with it")
    for name in ("reg", "wide", "fish"):
        speed(name, args.views, BOARD, args.repeats, mrcal)
    speed("reg", 200, LARGE, max(3, args.repeats // 4), mrcal)
    rig(60, max(3, args.repeats // 3), mrcal)
    ceres(args.views, args.repeats)
    scale(args.repeats)
    if args.failures:
        failures(args.failures, args.omnidir)


if __name__ == "__main__":
    main()
