"""Calibration beside its peers on the same corners: time, error, difference to the true lens, failures.

    python scripts/benchmark_calibration.py [--views 40] [--repeats 15] [--failures 20 [--omnidir 3]]

Times are medians of CPU seconds of one process with one thread, initialisation included, nothing given but the corners;
all peers of a table take turns, so that what else the machine does falls on each alike. RMS is 2-D per corner.
"Difference" is the projection against the true lens over its whole field after the best rotation, RMS in px.

mrcal is Debian's (apt-get install mrcal python3-mrcal) and runs in Debian's Python, timed in its own process.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from types import ModuleType
from typing import Any

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
os.environ.setdefault("OMP_NUM_THREADS", "1")

import cv2
import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))
from helpers.calibration_scenes import BOARD, REACH_DEG, SIZE, lens, projection_difference, random_views

from rigkit.boards import Board
from rigkit.calibration.calibrate import calibrate
from rigkit.calibration.initialise import initialise
from rigkit.calibration.observations import Observations
from rigkit.calibration.rig.calibrate import calibrate_rig
from rigkit.calibration.solver import State, solve
from rigkit.cameras.base import Camera
from rigkit.cameras.brown import Brown
from rigkit.cameras.kannala_brandt import KannalaBrandt
from rigkit.detections import BoardView
from rigkit.errors import RigkitError
from rigkit.geometry.rigid3 import Rigid3
from rigkit.geometry.rotation import exp_so3

NOISE_PX = 0.2
LARGE = Board("14x10", 14, 10, 30.0, 30.0)
DEBIAN_PYTHON = "/usr/bin/python3"
MRCAL_WORKER = Path(__file__).with_name("mrcal_worker.py")

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


class Mrcal:
    """mrcal on views by (frame, camera), started once; a context manager."""

    def __init__(self, views: Mapping[tuple[int, int], BoardView]) -> None:
        self._views = views
        self.last: dict[str, Any] = {}

    @staticmethod
    def available() -> bool:
        """Say whether Debian's mrcal is installed."""
        try:
            found = subprocess.run([DEBIAN_PYTHON, "-c", "import mrcal"], capture_output=True, check=False)
        except FileNotFoundError:
            return False
        return found.returncode == 0

    def __enter__(self) -> Mrcal:
        self._folder = tempfile.TemporaryDirectory()
        path = Path(self._folder.name) / "corners.npz"
        keys = sorted(self._views)
        board = self._views[keys[0]].board
        frames = {frame: i for i, frame in enumerate(dict.fromkeys(frame for frame, _ in keys))}
        observations = np.full((len(keys), board.rows, board.columns, 3), -1.0)
        for k, key in enumerate(keys):
            view = self._views[key]
            observations[k, view.grid[:, 1], view.grid[:, 0], :2] = view.pixels
            observations[k, view.grid[:, 1], view.grid[:, 0], 2] = 1.0
        frame_camera = np.array([(frames[frame], camera) for frame, camera in keys], dtype=np.int32)
        np.savez(path, observations=observations, frame_camera=frame_camera, spacing=board.square_x_mm, size=SIZE)
        environment = {k: v for k, v in os.environ.items() if not k.startswith("PYTHON")}
        self._process = subprocess.Popen(
            [DEBIAN_PYTHON, str(MRCAL_WORKER), str(path)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            env=environment,
        )
        return self

    def run(self) -> float:
        """Calibrate once; the answer is in `last`."""
        assert self._process.stdin is not None and self._process.stdout is not None
        self._process.stdin.write("run\n")
        self._process.stdin.flush()
        self.last = json.loads(self._process.stdout.readline())
        return float(self.last["seconds"])

    def cameras(self) -> list[Camera]:
        """Return the cameras of the last run."""
        return [Brown(SIZE, np.array(one)) for one in self.last["intrinsics"]]

    def __exit__(self, *_: object) -> None:
        assert self._process.stdin is not None
        self._process.stdin.close()
        self._process.wait()
        self._folder.cleanup()


def opencv_points(views: list[BoardView], dtype: type = np.float32) -> tuple[list[np.ndarray], list[np.ndarray]]:
    return [v.points().astype(dtype)[None] for v in views], [v.pixels.astype(dtype)[None] for v in views]


def opencv_regular(views: list[BoardView]) -> tuple[float, Camera]:
    objects, images = opencv_points(views)
    rms, K, d, _, _ = cv2.calibrateCamera([o[0] for o in objects], [i[0] for i in images], SIZE, None, None)
    return rms, Brown(SIZE, np.array([K[0, 0], K[1, 1], K[0, 2], K[1, 2], *d.ravel()[:5]]))


def opencv_fisheye(views: list[BoardView], guess: np.ndarray | None = None) -> tuple[float, Camera]:
    """As in its documentation: extrinsics recomputed in each iteration, no skew. Without the former it ends anywhere.

    `guess` is K where there is one.
    """
    objects, images = opencv_points(views, np.float64)
    flags = fisheye_flag("RECOMPUTE_EXTRINSIC") | fisheye_flag("FIX_SKEW")
    if guess is not None:
        flags |= fisheye_flag("USE_INTRINSIC_GUESS")
    K0 = np.eye(3) if guess is None else guess.copy()
    rms, K, d, _, _ = cv2.fisheye.calibrate(objects, images, SIZE, K0, np.zeros((4, 1)), flags=flags)
    return rms, KannalaBrandt(SIZE, np.array([K[0, 0], K[1, 1], K[0, 2], K[1, 2], *d.ravel()[:4]]))


def fisheye_flag(name: str) -> int:
    """Return a flag of cv2.fisheye: OpenCV 5 has moved them out of that module."""
    return int(getattr(cv2.fisheye, f"CALIB_{name}", None) or getattr(cv2, f"CALIB_{name}"))


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
            "cv2.calibrateCamera": lambda: opencv_regular(views),
        }
    else:
        solvers = {
            "rigkit kannala_brandt": lambda: ours(views, "kannala_brandt", None),
            "rigkit scaramuzza 6": lambda: ours(views, "scaramuzza", 6),
            "cv2.fisheye": lambda: opencv_fisheye(views),
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
        with Mrcal({(k, 0): view for k, view in enumerate(views)}) as peer:
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
    models = []

    def run() -> float:
        model = colmap_model(pycolmap, views, start)
        models[:] = [model]
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
        return clocked(adjuster.solve)()

    own = clocked(lambda: solve(observations, start, prior_sigma_px=0.0))
    spent = timed({"rigkit": own, "Ceres": run}, repeats)
    model = models[0]
    camera = model.cameras[1]
    fitted = camera.params - np.array([0.0, 0.0, 0.5, 0.5, 0.0, 0.0, 0.0, 0.0])
    squared = sum(
        float(((camera.img_from_cam(v.points() @ R.T + t) - 0.5 - v.pixels) ** 2).sum())
        for v, (R, t) in zip(views, _colmap_poses(model), strict=True)
    )
    cost = float(found.data.costs.sum())
    apart = np.abs(found.state.camera.parameters - fitted)[:2].max()
    print(
        f"\nSolver alone from the same start, kannala_brandt, {count} views of 54: rigkit "
        f"{1000 * spent['rigkit']:.1f} ms, Ceres {1000 * spent['Ceres']:.1f} ms "
        f"({spent['Ceres'] / spent['rigkit']:.1f} times); cost {cost:.8f} and {squared:.8f}, relative difference "
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
                _fails(lambda views=views: ours(views, "kannala_brandt", None)[0]),
                _fails(lambda views=views: opencv_fisheye(views)[0]),
                _fails(lambda views=views, K=K: opencv_fisheye(views, K)[0]),
            ]
            slow += seed < omnidir and _fails(lambda views=views: _omnidir(views))
        tried = min(seeds, omnidir)
        rows.append([name, f"{reach:g}", str(count), *(f"{n} of {seeds}" for n in failed), f"{slow} of {tried}"])
    columns = ["lens", "boards out to deg", "views", "rigkit", "cv2.fisheye", "with K 5 % off", "cv2.omnidir"]
    table("Failures (RMS beyond 1.1 times the noise, views dropped, or an exception), no guess", columns, rows)


def _fails(run: Callable[[], float]) -> bool:
    try:
        return not run() < 1.1 * NOISE_PX * np.sqrt(2.0)
    except (cv2.error, RigkitError):
        return True


def _omnidir(views: list[BoardView]) -> float:
    objects, images = opencv_points(views, np.float64)
    criteria = (cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 200, 1e-8)
    rms, *_, used = cv2.omnidir.calibrate(objects, images, SIZE, None, None, None, 0, criteria)
    return float(rms) if np.size(used) == len(views) else np.inf


def scale(repeats: int) -> None:
    base, _, _ = random_views(lens("fish"), 250, np.random.default_rng(2), reach_deg=92.5)
    rows = []
    for count in (50, 250, 500, 1000, 2000):
        views = [
            BoardView(f"{k}", v.board, v.grid, v.pixels, v.sigma_px)
            for k, v in enumerate((base * (count // len(base) + 1))[:count])
        ]
        run = clocked(lambda views=views: ours(views, "kannala_brandt", None))
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
        result[1] = multiview(views, frames)

    runs = {"rigkit brown 5": clocked(own), "cv2.calibrateMultiview": clocked(opencv)}
    if mrcal:
        by_key = {(int(f), k): view for k, name in enumerate(views) for f, view in views[name]}
        with Mrcal(by_key) as peer:
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
