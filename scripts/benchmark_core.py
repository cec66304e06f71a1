"""Compare the speed of affine and epipolar estimation on one core with a plain loop, OpenCV, COLMAP and PoseLib.

python scripts/benchmark_core.py [--only affine|epipolar|robust] [--corners 1000000] [--json]

Matches are SIMULATED. Times are processor times. Ratios are rigkit's rate over the other's on the same problems: above
1 rigkit is faster. PoseLib is optional (pip install poselib). If both programs estimate the same pose, the median
errors are shown too.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, field
from functools import partial
from typing import Any

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
os.environ.setdefault("OMP_NUM_THREADS", "1")

import cv2
import numpy as np
from core_speed.loops import loop_affine, loop_normal, loop_planar
from core_speed.peers import colmap_robust, opencv_robust, optional, poselib_refine, poselib_robust
from core_speed.scenes import CAMERA, CONDITIONS, NOISE_PX, POSE, SIGMA_A, contaminated, jacobians, scene

from rigkit.affine.affinities import EpipolarNormals
from rigkit.affine.normal import normals_from_affines
from rigkit.affine.registry import AFFINE_METHODS, affines_from_directions
from rigkit.core.matches import DirectionPairs, Matches
from rigkit.geometry.rigid3 import Rigid3
from rigkit.geometry.rotation import angle_between, rotation_angle
from rigkit.geometry.triangulation import correct_lindstrom, triangulate_rays
from rigkit.kernels.pose import five_rows, six_rows
from rigkit.relative_pose.refinement.refine import estimate_pose, refine_pose
from rigkit.relative_pose.robust import robust_pose
from rigkit.relative_pose.solvers.planar import solve_planar_batch
from rigkit.relative_pose.solvers.pose import essential_from_pose
from rigkit.relative_pose.solvers.registry import fundamental_for
from rigkit.relative_pose.solvers.rows import PLANAR_ENTRIES, affinity_rows, point_rows

DIRECTION_NOISE_RAD = np.radians(0.3)
REPEATS = 3
LOOPED = 300
"""Problems that are enough to time a plain loop."""
ROBUST_SCENES = 24


@dataclass
class Row:
    """One line of the benchmark; `ratios` maps another way of doing the same to rigkit's rate over its."""

    name: str
    per_second: float
    ratios: dict[str, float] = field(default_factory=dict)
    remark: str = ""


def rate(count: int, run: Callable[[], object]) -> float:
    """Return problems a second, best of a few runs."""
    times = []
    for _ in range(REPEATS):
        start = time.process_time()
        run()
        times.append(time.process_time() - start)
    return count / min(times)


def row(name: str, count: int, run: Callable[[], object], remark: str = "", **others: Any) -> Row:
    """Time `run` and its rivals, given as name=(count, run); None stands for a rival that is not installed."""
    own = rate(count, run)
    ratios = {label.replace("_", " "): own / rate(*rival) for label, rival in others.items() if rival is not None}
    return Row(name, own, ratios, remark)


def noisy_directions(rng: np.random.Generator, A21: np.ndarray, count: int) -> DirectionPairs:
    angle = np.arange(count) * np.pi / count + rng.uniform(-0.2, 0.2, (len(A21), count))
    d1 = 40.0 * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    d2 = d1 @ np.swapaxes(A21, 1, 2)
    turn = DIRECTION_NOISE_RAD * rng.normal(size=angle.shape)
    c, s = np.cos(turn), np.sin(turn)
    d2 = np.stack([c * d2[..., 0] - s * d2[..., 1], s * d2[..., 0] + c * d2[..., 1]], axis=-1)
    return DirectionPairs(
        image1=d1, image2=d2, valid=np.ones(angle.shape, dtype=bool), kinds=tuple(map(str, range(count)))
    )


def affine_rows(corners: int) -> Iterator[Row]:
    """Affine estimators and normals; remark: the largest difference to the loop's answers."""
    rng = np.random.default_rng(1)
    m = scene(rng, corners)
    epipolar = EpipolarNormals.of_matches(m, essential_from_pose(POSE))
    assert m.A21 is not None
    for count in (3, 6):
        d = noisy_directions(rng, m.A21, count)
        for method in AFFINE_METHODS:

            def batched(method: str = method, d: DirectionPairs = d) -> np.ndarray:
                return affines_from_directions(d, method, epipolar=epipolar, min_conditioning=0.0).A21

            def loop(method: str = method, d: DirectionPairs = d) -> np.ndarray:
                each = zip(d.image1[:LOOPED], d.image2[:LOOPED], epipolar.n1, epipolar.n2, strict=False)
                return np.array([loop_affine(method, *one) for one in each])

            off = float(np.nanmax(np.abs(loop() - batched()[:LOOPED])))
            name = f"{method}, {count} directions"
            yield row(name, corners, batched, f"difference {off:.0e}", loop=(LOOPED, loop))
    points, _ = triangulate_rays(m.rays1, m.rays2, POSE)
    J1, J2 = jacobians(m, points)
    A21 = m.A21

    def loop_normals() -> np.ndarray:
        return np.array([loop_normal(*one) for one in zip(J1[:LOOPED], J2, A21, strict=False)])

    off = float(np.abs(loop_normals() - normals_from_affines(J1, J2, A21)[0][:LOOPED]).max())
    yield row(
        "normals",
        corners,
        lambda: normals_from_affines(J1, J2, A21),
        f"difference {off:.0e}",
        loop=(LOOPED, loop_normals),
    )


def epipolar_rows() -> Iterator[Row]:
    """Planar and minimal solvers, poses, corrections and triangulation."""
    rng = np.random.default_rng(0)
    yield from planar_rows(rng)
    yield from minimal_rows(rng)
    m = scene(rng, 150)
    for kind in ("general", "planar"):
        yield row(f"{kind}, 150 matches, linear", 1, partial(fundamental_for(kind).solve, m))
    points = Matches.from_cameras(CAMERA, CAMERA, m.pixels1, m.pixels2, sigma1_px=m.sigma1_px, sigma2_px=m.sigma2_px)
    yield row(
        "general, 150 points, maximum likelihood from a pose",
        1,
        lambda: refine_pose(points, POSE),
        PoseLib=poselib_refine(points),
    )
    yield row("planar, 150 points and affinities, from scratch", 1, lambda: estimate_pose(m, "planar"))
    yield from triangulation_rows(rng)


def planar_rows(rng: np.random.Generator, problems: int = 20000, each: int = 10) -> Iterator[Row]:
    m = scene(rng, problems * each)
    A21 = m.A21
    assert A21 is not None
    entries = np.array(PLANAR_ENTRIES)

    def grams() -> np.ndarray:
        points = point_rows(m.rays1, m.rays2)[:, None, entries]
        affine = affinity_rows(m.rays1, m.rays2, m.jacobians1, m.jacobians2, A21)[..., entries]
        rows = np.concatenate([points, affine * (NOISE_PX / SIGMA_A)], axis=1).reshape(problems, 3 * each, 4)
        return np.asarray(np.swapaxes(rows, 1, 2) @ rows)

    made = grams()

    def loop() -> None:
        for gram in made[:LOOPED]:
            loop_planar(gram)

    def best_cost(gram: np.ndarray) -> float:
        e = loop_planar(gram)
        return float(e @ gram @ e)

    ours = solve_planar_batch(made[:LOOPED])[1]
    worse = float(np.max(ours / np.array([best_cost(gram) for gram in made[:LOOPED]]))) - 1.0
    remark = f"cost at most {worse:+.0e} of the loop's"
    yield row(
        f"planar, {each} correspondences", problems, lambda: solve_planar_batch(made), remark, loop=(LOOPED, loop)
    )
    yield row("the same with making the equations", problems, lambda: solve_planar_batch(grams()))


def minimal_rows(rng: np.random.Generator, problems: int = 2000) -> Iterator[Row]:
    m = scene(rng, 7 * problems)
    A21 = m.A21
    assert A21 is not None
    points = point_rows(m.rays1, m.rays2).reshape(problems, 7, 9)
    affine = affinity_rows(m.rays1, m.rays2, m.jacobians1, m.jacobians2, A21).reshape(problems, 14, 9)
    pixels = [q.reshape(problems, 7, 2)[:LOOPED] for q in (m.pixels1, m.pixels2)]
    rays = [np.ascontiguousarray(f.reshape(problems, 7, 3)[:LOOPED, :5]) for f in (m.rays1, m.rays2)]

    def opencv_five() -> None:
        for a, b in zip(*pixels, strict=True):
            cv2.findEssentialMat(a[:5], b[:5], CAMERA.K, method=0)

    def poselib_five(poselib: Any) -> None:
        for a, b in zip(*rays, strict=True):
            poselib.essential_matrix_5pt(a, b)

    poselib = optional("poselib")
    yield row(
        "minimal E, 5 points",
        problems,
        lambda: five_rows(points[:, :5]),
        OpenCV=(LOOPED, opencv_five),
        PoseLib=poselib and (LOOPED, lambda: poselib_five(poselib)),
    )
    mixed = np.concatenate([points[:, :2], affine[:, :4]], axis=1)
    yield row("minimal E, 2 affine correspondences", problems, lambda: six_rows(mixed))


def triangulation_rows(rng: np.random.Generator, count: int = 100_000, few: int = 2000) -> Iterator[Row]:
    m = scene(rng, count)
    inverse = np.linalg.inv(CAMERA.K)
    F21 = inverse.T @ essential_from_pose(POSE) @ inverse
    F21 /= np.linalg.norm(F21)
    q1, q2 = m.pixels1, m.pixels2

    def opencv() -> object:
        return cv2.correctMatches(F21, q1[None, :few], q2[None, :few])

    yield row(
        "Lindstrom correction", count, lambda: correct_lindstrom(q1, q2, F21), OpenCV_correctMatches=(few, opencv)
    )
    P1, P2 = CAMERA.K @ np.eye(3, 4), CAMERA.K @ POSE.matrix()[:3]
    yield row(
        "triangulation, optimum in pixels on rays",
        count,
        lambda: triangulate_rays(m.rays1, m.rays2, POSE, jacobians1=m.jacobians1, jacobians2=m.jacobians2),
        OpenCV_linear=(count, lambda: cv2.triangulatePoints(P1, P2, q1.T, q2.T)),
    )


def robust_rows() -> Iterator[Row]:
    """Contaminated matches: errors over a few scenes (median, worst), and the time of one."""
    ways: dict[str, Callable[[Matches], Rigid3 | None]] = {
        "rigkit": lambda m: robust_pose(m, np.random.default_rng(0)).refined.cam2_from_cam1,
        "rigkit, affine samples": lambda m: (
            robust_pose(m, np.random.default_rng(0), sample="affine").refined.cam2_from_cam1
        ),
        "OpenCV MAGSAC": opencv_robust,
        "COLMAP": colmap_robust,
        "PoseLib": poselib_robust,
    }
    warm = scene(np.random.default_rng(0), 100)
    ways = {name: way for name, way in ways.items() if way(warm) is not None}
    for like in CONDITIONS:
        rng = np.random.default_rng(3)
        scenes = [contaminated(rng, like) for _ in range(ROBUST_SCENES)]
        rates: dict[str, float] = {}
        for name, way in ways.items():
            start = time.process_time()
            poses = [way(m) for m in scenes]
            rates[name] = len(scenes) / (time.process_time() - start)
            errors = np.degrees([pose_errors(pose, like.pose) for pose in poses if pose is not None])
            middle, worst = np.median(errors, axis=0), errors.max(axis=0)
            ratios = {"rigkit": rates[name] / rates["rigkit"]} if name != "rigkit" else {}
            remark = f"rotation {middle[0]:.4f} ({worst[0]:.3f}), direction {middle[1]:.4f} ({worst[1]:.3f}) deg"
            yield Row(f"robust pose, {like.name}: {name}", rates[name], ratios, remark)


def pose_errors(pose: Rigid3, true: Rigid3) -> tuple[float, float]:
    turn = float(rotation_angle(pose.rotation @ true.rotation.T))
    return turn, float(angle_between(pose.translation_mm, true.translation_mm))


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--only", choices=("affine", "epipolar", "robust"))
    parser.add_argument("--corners", type=int, default=1_000_000)
    parser.add_argument("--json", action="store_true")
    args = parser.parse_args()
    parts: dict[str, Callable[[], Iterator[Row]]] = {
        "affine": lambda: affine_rows(args.corners),
        "epipolar": epipolar_rows,
        "robust": robust_rows,
    }
    rows = []
    for part, make in parts.items():
        for made in make() if args.only in (None, part) else ():
            rows.append(made)
            if not args.json:
                ratios = ", ".join(f"{value:.3g} x {other}" for other, value in made.ratios.items())
                print(f"{made.name:<52}{made.per_second:>12,.0f} /s   {ratios:<32} {made.remark}".rstrip(), flush=True)
    if args.json:
        print(json.dumps([asdict(made) for made in rows], indent=1))
    return 0


if __name__ == "__main__":
    sys.exit(main())
