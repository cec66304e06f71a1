"""Calibration beside its peers on the same corners: time, error, difference to the true lens, failures.

    python scripts/benchmark_calibration.py [--views 40] [--repeats 7] [--failures 20]

Times are medians of CPU seconds of one process, initialisation included, nothing given but the corners. "difference" is
the projection against the true lens over its whole field after the best rotation, RMS in px.
"""

from __future__ import annotations

import argparse
import os
import statistics
import sys
import time
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import cv2
import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))
from helpers.calibration_scenes import REACH_DEG, SIZE, lens, projection_difference, random_views

from rigkit.calibration.calibrate import calibrate
from rigkit.calibration.initialise import initialise
from rigkit.calibration.observations import Observations
from rigkit.calibration.rig import calibrate_rig
from rigkit.calibration.solver import State, solve
from rigkit.cameras.base import Camera
from rigkit.cameras.brown import Brown
from rigkit.cameras.kannala_brandt import KannalaBrandt
from rigkit.detections import BoardView
from rigkit.errors import RigkitError
from rigkit.geometry.rigid3 import Rigid3
from rigkit.geometry.rotation import exp_so3

OMNIDIR_FAILED_PX = 1.0


def timed(function: Callable[[], object], repeats: int) -> float:
    """Return the median CPU seconds of a call."""
    function()
    spent = []
    for _ in range(repeats):
        start = time.process_time()
        function()
        spent.append(time.process_time() - start)
    return statistics.median(spent)


def opencv_points(views: list[BoardView], dtype: type = np.float32) -> tuple[list[np.ndarray], list[np.ndarray]]:
    return [v.points().astype(dtype)[None] for v in views], [v.pixels.astype(dtype)[None] for v in views]


def opencv_regular(views: list[BoardView]) -> tuple[float, Camera]:
    objects, images = opencv_points(views)
    rms, K, d, _, _ = cv2.calibrateCamera([o[0] for o in objects], [i[0] for i in images], SIZE, None, None)
    return rms, Brown(SIZE, np.array([K[0, 0], K[1, 1], K[0, 2], K[1, 2], *d.ravel()[:5]]))


def opencv_fisheye(views: list[BoardView]) -> tuple[float, Camera]:
    objects, images = opencv_points(views, np.float64)
    flags = (
        cv2.fisheye.CALIB_RECOMPUTE_EXTRINSIC | cv2.fisheye.CALIB_FIX_SKEW
        if hasattr(cv2.fisheye, "CALIB_FIX_SKEW")
        else 0
    )
    rms, K, d, _, _ = cv2.fisheye.calibrate(objects, images, SIZE, np.eye(3), np.zeros((4, 1)), flags=flags)
    return rms, KannalaBrandt(SIZE, np.array([K[0, 0], K[1, 1], K[0, 2], K[1, 2], *d.ravel()[:4]]))


def ours(views: list[BoardView], model: str, degree: int | None) -> tuple[float, Camera]:
    result = calibrate(views, SIZE, model=model, degree=degree, board="flat", folds=0)
    return result.rms_px, result.camera


def speed(count: int, repeats: int) -> None:
    print(f"\n{count} views of 54 corners, 0.2 px noise, median of {repeats} runs")
    print(f"{'lens':8} {'solver':28} {'CPU ms':>8} {'ratio':>6} {'RMS px':>8} {'difference px':>14}")
    rows = [
        ("reg", [("rigkit brown 5", lambda v: ours(v, "brown", 5)), ("cv2.calibrateCamera", opencv_regular)]),
        (
            "wide",
            [
                ("rigkit kannala_brandt", lambda v: ours(v, "kannala_brandt", None)),
                ("rigkit scaramuzza 6", lambda v: ours(v, "scaramuzza", 6)),
                ("cv2.fisheye", opencv_fisheye),
            ],
        ),
        (
            "fish",
            [
                ("rigkit kannala_brandt", lambda v: ours(v, "kannala_brandt", None)),
                ("rigkit scaramuzza 6", lambda v: ours(v, "scaramuzza", 6)),
                ("cv2.fisheye", opencv_fisheye),
            ],
        ),
    ]
    for name, solvers in rows:
        views, _, _ = random_views(lens(name), count, np.random.default_rng(1), reach_deg=REACH_DEG[name])
        first = None
        for solver, run in solvers:
            try:
                rms, camera = run(views)
                difference = projection_difference(camera, lens(name), 0.95 * REACH_DEG[name])
                spent = timed(lambda run=run, views=views: run(views), repeats)
                first = first or spent
                error = f"{np.sqrt((difference**2).mean()):14.3f}"
            except (cv2.error, RigkitError, AssertionError) as failed:
                print(f"{name:8} {solver:28} failed: {(str(failed) or 'no sensible camera').splitlines()[0][:70]}")
                continue
            print(f"{name:8} {solver:28} {1000 * spent:8.1f} {spent / first:6.1f} {rms:8.4f} {error}")


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
    own = timed(lambda: solve(observations, start, prior_sigma_px=0.0), repeats)
    spent = []
    for _ in range(repeats + 1):
        model = colmap_model(pycolmap, views, start)
        options = pycolmap.BundleAdjustmentOptions()
        options.refine_focal_length = options.refine_principal_point = options.refine_extra_params = True
        options.print_summary = False
        options.ceres.solver_options.num_threads = 1
        config = pycolmap.BundleAdjustmentConfig()
        for image_id in model.images:
            config.add_image(image_id)
        for point_id in model.points3D:
            config.add_constant_point(point_id)
        adjuster = pycolmap.create_default_ceres_bundle_adjuster(options, config, model)
        begin = time.process_time()
        adjuster.solve()
        spent.append(time.process_time() - begin)
    theirs = statistics.median(spent[1:])
    camera = model.cameras[1]
    fitted = camera.params - np.array([0.0, 0.0, 0.5, 0.5, 0.0, 0.0, 0.0, 0.0])
    squared = sum(
        float(((camera.img_from_cam(v.points() @ R.T + t) - 0.5 - v.pixels) ** 2).sum())
        for v, (R, t) in zip(views, _colmap_poses(model), strict=True)
    )
    cost = float(found.data.costs.sum())
    apart = np.abs(found.state.camera.parameters - fitted)[:2].max()
    print(
        f"\nSolver alone from the same start, kannala_brandt, {count} views of 54: rigkit {1000 * own:.1f} ms, Ceres "
        f"{1000 * theirs:.1f} ms ({theirs / own:.1f} times); cost {cost:.8f} and {squared:.8f}, relative difference "
        f"{(cost - squared) / squared:.1e}; focal lengths apart by {apart:.1e} px"
    )


def colmap_model(pycolmap: ModuleType, views: list[BoardView], start: State) -> Any:
    """Return a pycolmap reconstruction of the views at the start: one camera, the board's corners as fixed points."""
    model = pycolmap.Reconstruction()
    parameters = start.camera.parameters.copy()
    parameters[2:4] += 0.5
    model.add_camera_with_trivial_rig(
        pycolmap.Camera(camera_id=1, model="OPENCV_FISHEYE", width=SIZE[0], height=SIZE[1], params=parameters.tolist())
    )
    for k, view in enumerate(views):
        image = pycolmap.Image(name=f"{k}", keypoints=view.pixels + 0.5, camera_id=1, image_id=k + 1)
        pose = np.column_stack([start.rotation[k], start.translation_mm[k]])
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(pose))
    for j, point in enumerate(views[0].points()):
        track = pycolmap.Track()
        for k in range(len(views)):
            track.add_element(k + 1, j)
        model.add_point3D(point, track)
    return model


def _colmap_poses(model: Any) -> list[tuple[np.ndarray, np.ndarray]]:
    matrices = [model.images[k].cam_from_world().matrix() for k in sorted(model.images)]
    return [(m[:, :3], m[:, 3]) for m in matrices]


def multiview(views: dict[str, list[tuple[str, BoardView]]], frames: int) -> list[np.ndarray]:
    """Return the mounts' translations by cv2.calibrateMultiview, mm."""
    seen = {name: dict(own) for name, own in views.items()}
    used = [str(f) for f in range(frames) if any(str(f) in own for own in seen.values())]
    board = next(iter(views.values()))[0][1].board
    blank = np.full((board.corner_count, 2), -1.0, np.float32)
    pixels = [[own[f].pixels.astype(np.float32) if f in own else blank for f in used] for own in seen.values()]
    mask = np.array([[255 * (f in own) for f in used] for own in seen.values()], dtype=np.uint8)
    # In squares: it takes a board in mm for a line.
    objects3 = [(board.points() / board.square_x_mm).astype(np.float32)] * len(used)
    sizes = [SIZE] * len(seen)
    pinhole = np.zeros(len(seen), np.uint8)
    *_, T = cv2.calibrateMultiview(objects3, pixels, sizes, mask, pinhole, None, None, None, None)
    return [np.ravel(t) * board.square_x_mm for t in T]


def failures(seeds: int) -> None:
    print(f"\nFailures out of {seeds}: 20 views of a 185-degree lens, boards out to the angle given, no guess")
    for reach in (60.0, 75.0, 85.0, 92.5):
        counts = {"rigkit": 0, "cv2.fisheye": 0, "cv2.omnidir": 0}
        for seed in range(seeds):
            views, _, _ = random_views(lens("fish"), 20, np.random.default_rng(1000 + seed), reach_deg=reach)
            counts["rigkit"] += _fails(lambda views=views: ours(views, "kannala_brandt", None)[0])
            counts["cv2.fisheye"] += _fails(lambda views=views: opencv_fisheye(views)[0])
            counts["cv2.omnidir"] += _fails(lambda views=views: _omnidir(views))
        print(f"  {reach:5.1f} deg: " + ", ".join(f"{k} {v}" for k, v in counts.items()))


def _fails(run: Callable[[], float]) -> bool:
    try:
        return not run() < 1.1 * 0.2 * np.sqrt(2.0)
    except (cv2.error, RigkitError):
        return True


def _omnidir(views: list[BoardView]) -> float:
    objects, images = opencv_points(views, np.float64)
    criteria = (cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 200, 1e-8)
    rms, *_, used = cv2.omnidir.calibrate(objects, images, SIZE, None, None, None, 0, criteria)
    return float(rms) if np.size(used) == len(views) else np.inf


def scale(repeats: int) -> None:
    print("\nCost against the number of views (kannala_brandt, fish)")
    base, _, _ = random_views(lens("fish"), 250, np.random.default_rng(2), reach_deg=92.5)
    for count in (50, 250, 500, 1000, 2000):
        views = [
            BoardView(f"{k}", v.board, v.grid, v.pixels, v.sigma_px)
            for k, v in enumerate((base * (count // len(base) + 1))[:count])
        ]
        spent = timed(lambda views=views: ours(views, "kannala_brandt", None), max(1, repeats // 3))
        print(f"  {count:5d} views: {1000 * spent:8.1f} ms, {1e6 * spent / count:6.1f} us a view")


def rig(frames: int, repeats: int) -> None:
    """Four cameras on a bar; mounts against the truth."""
    rng = np.random.default_rng(3)
    cameras = [lens("reg")] * 4
    mounts = [Rigid3(exp_so3(0.1 * rng.normal(size=3)), [-100.0 * k, 5.0 * k, 3.0 * k]) for k in range(4)]
    mounts[0] = Rigid3.identity()
    board = random_views(lens("reg"), 1, rng, reach_deg=33.0)[0][0].board
    views: dict[str, list[tuple[str, BoardView]]] = {f"c{k}": [] for k in range(4)}
    for f in range(frames):
        turn = exp_so3(rng.normal(size=3) * np.array([0.4, 0.4, 1.5]))
        place = np.array([rng.uniform(-250, 400), rng.uniform(-200, 200), rng.uniform(700, 1100)])
        pose = Rigid3(turn, place - turn @ board.points().mean(axis=0))
        for k, (camera, mount) in enumerate(zip(cameras, mounts, strict=True)):
            pixels, valid = camera.project((mount @ pose).apply(board.points()))
            if valid.all() and camera.on_image(pixels).all():
                noisy = np.clip(pixels + 0.2 * rng.normal(size=pixels.shape), 0.0, np.array(SIZE) - 1.0)
                views[f"c{k}"].append((str(f), BoardView(f"c{k}-{f}", board, board.grid(), noisy, np.full(54, 0.2))))
    sizes = dict.fromkeys(views, SIZE)
    spent = timed(lambda: calibrate_rig(views, sizes, model="brown", degree=5, folds=0), repeats)
    result = calibrate_rig(views, sizes, model="brown", degree=5, folds=0)
    errors = [
        float(np.linalg.norm(c.cam_from_rig.translation_mm - m.translation_mm))
        for c, m in zip(result.cameras, mounts, strict=True)
    ]
    count = sum(len(v) for v in views.values())
    moved = np.array([m.translation_mm for m in mounts])
    theirs = timed(lambda: multiview(views, frames), repeats)
    apart = float(np.linalg.norm(np.array(multiview(views, frames)) - moved, axis=1).max())
    print(
        f"\nRig of 4 cameras, {frames} frames, {count} views: {1000 * spent:.0f} ms, mounts off by {max(errors):.3f} mm"
        f"; cv2.calibrateMultiview {1000 * theirs:.0f} ms ({theirs / spent:.1f} times), {apart:.3f} mm"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--views", type=int, default=40)
    parser.add_argument("--repeats", type=int, default=7)
    parser.add_argument("--failures", type=int, default=0, help="seeds of the failure table (slow: cv2.omnidir)")
    args = parser.parse_args()
    cv2.setNumThreads(1)
    speed(args.views, args.repeats)
    ceres(args.views, args.repeats)
    scale(args.repeats)
    rig(60, max(1, args.repeats // 2))
    if args.failures:
        failures(args.failures)


if __name__ == "__main__":
    main()
