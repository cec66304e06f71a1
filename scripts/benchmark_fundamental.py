"""Time of the epipolar core, beside a plain loop and OpenCV where they do the same.

One core: set OPENBLAS_NUM_THREADS=1. Printed are problems (or points) a second, best of three.
"""

from __future__ import annotations

import time
from collections.abc import Callable

import cv2
import numpy as np

from rigkit.cameras.pinhole import Pinhole
from rigkit.fundamental.minimal import essential_from_five_rows, essential_from_six_rows, fundamental_from_seven_rows
from rigkit.fundamental.planar import solve_planar_batch
from rigkit.fundamental.refine import estimate_pose
from rigkit.fundamental.registry import fundamental_for
from rigkit.fundamental.rows import PLANAR_ENTRIES, affinity_rows, point_rows
from rigkit.geometry.rigid3 import Rigid3
from rigkit.geometry.rotation import exp_so3, skew, unit
from rigkit.geometry.triangulation import correct_hartley_sturm, correct_lindstrom, triangulate_rays
from rigkit.matches import Matches

CAMERA = Pinhole((1624, 1240), np.array([1350.0, 1350.0, 800.0, 620.0]))
POSE = Rigid3(exp_so3(np.array([0.0, 0.1, 0.0])), [-290.0, 0.0, -70.0])
NOISE_PX, SIGMA_A = 0.3, 0.02


def best_of_three(run: Callable[[], object]) -> float:
    """Return the shortest time of three runs, s."""
    times = []
    for _ in range(3):
        start = time.perf_counter()
        run()
        times.append(time.perf_counter() - start)
    return min(times)


def scene(rng: np.random.Generator, count: int) -> Matches:
    """Matches of `count` points in view of both cameras, with noisy affinities of random facets."""
    X = rng.uniform([-350, -300, 900], [350, 300, 1800], (count, 3))
    q1, _, J1, _ = CAMERA.project_with_jacobians(X)
    q2, _, J2, _ = CAMERA.project_with_jacobians(POSE.apply(X))
    normals = unit(-unit(X) + 0.4 * rng.normal(size=X.shape))
    tangents = np.linalg.svd(normals[:, None, :])[2][:, 1:].swapaxes(1, 2)
    A21 = (J2 @ POSE.rotation @ tangents) @ np.linalg.inv(J1 @ tangents) + rng.normal(size=(count, 2, 2)) * SIGMA_A
    noise1, noise2 = (rng.normal(size=q1.shape) * NOISE_PX for _ in range(2))
    sigma = np.full(count, NOISE_PX)
    return Matches.from_cameras(
        CAMERA,
        CAMERA,
        q1 + noise1,
        q2 + noise2,
        sigma1_px=sigma,
        sigma2_px=sigma,
        A21=A21,
        sigma_A=np.full(count, SIGMA_A),
    )


def planar_grams(rng: np.random.Generator, problems: int, each: int) -> np.ndarray:
    """Return Gram matrices (B, 4, 4) of planar problems of `each` correspondences with affinities."""
    m = scene(rng, problems * each)
    entries = np.array(PLANAR_ENTRIES)
    weight = NOISE_PX / SIGMA_A
    points = point_rows(m.rays1, m.rays2)[:, None, entries]
    affine = affinity_rows(m.rays1, m.rays2, m.jacobians1, m.jacobians2, m.A21)[..., entries] * weight
    rows = np.concatenate([points, affine], axis=1).reshape(problems, 3 * each, 4)
    return np.asarray(np.swapaxes(rows, 1, 2) @ rows)


def report(
    name: str,
    count: int,
    run: Callable[[], object],
    other: tuple[str, int, Callable[[], object]] | None = None,
) -> None:
    """Print the rate of `run`, and its ratio to another way of doing the same."""
    rate = count / best_of_three(run)
    line = f"{name:<44} {rate:>12,.0f} /s"
    if other is not None:
        label, other_count, other_run = other
        line += f"   {rate / (other_count / best_of_three(other_run)):>7.1f} x {label}"
    print(line)


def main() -> None:
    rng = np.random.default_rng(0)
    problems = 20000
    grams = planar_grams(rng, problems, 10)

    def loop() -> None:
        for gram in grams[:500]:
            solve_planar_batch(gram[None])

    report("planar, 10 correspondences, solve", problems, lambda: solve_planar_batch(grams), ("plain loop", 500, loop))
    report("the same with making scene and rows", 4000, lambda: solve_planar_batch(planar_grams(rng, 4000, 10)))

    m = scene(rng, 7 * 2000)
    points = point_rows(m.rays1, m.rays2).reshape(2000, 7, 9)
    affine = affinity_rows(m.rays1, m.rays2, m.jacobians1, m.jacobians2, m.A21).reshape(2000, 14, 9)
    report("minimal F, 7 points", 2000, lambda: fundamental_from_seven_rows(points))
    pixels = m.pixels1.reshape(2000, 7, 2), m.pixels2.reshape(2000, 7, 2)

    def opencv_essential() -> None:
        for a, b in zip(pixels[0][:200], pixels[1][:200], strict=True):
            cv2.findEssentialMat(a[:5], b[:5], CAMERA.K, method=0)

    report(
        "minimal E, 5 points",
        2000,
        lambda: essential_from_five_rows(points[:, :5]),
        ("OpenCV findEssentialMat", 200, opencv_essential),
    )
    report(
        "minimal E, 2 affine correspondences",
        2000,
        lambda: essential_from_six_rows(np.concatenate([points[:, :2], affine[:, :4]], axis=1)),
    )

    m = scene(rng, 150)
    for kind in ("general", "planar"):
        report(f"{kind}, 150 matches, linear", 1, lambda kind=kind: fundamental_for(kind).solve(m))
        report(f"{kind}, 150 matches, maximum likelihood", 1, lambda kind=kind: estimate_pose(m, kind))

    m = scene(rng, 100000)
    inverse = np.linalg.inv(CAMERA.K)
    F21 = inverse.T @ skew(POSE.translation_mm) @ POSE.rotation @ inverse
    F21 /= np.linalg.norm(F21)
    few = 2000
    report("Lindstrom correction", len(m), lambda: correct_lindstrom(m.pixels1, m.pixels2, F21))
    report(
        "Hartley-Sturm correction",
        few,
        lambda: correct_hartley_sturm(m.pixels1[:few], m.pixels2[:few], F21),
        ("OpenCV correctMatches", few, lambda: cv2.correctMatches(F21, m.pixels1[None, :few], m.pixels2[None, :few])),
    )
    P1, P2 = CAMERA.K @ np.eye(3, 4), CAMERA.K @ POSE.matrix()[:3]
    report(
        "triangulation on rays, pixel optimum",
        len(m),
        lambda: triangulate_rays(m.rays1, m.rays2, POSE, jacobians1=m.jacobians1, jacobians2=m.jacobians2),
        ("OpenCV triangulatePoints (linear)", len(m), lambda: cv2.triangulatePoints(P1, P2, m.pixels1.T, m.pixels2.T)),
    )


if __name__ == "__main__":
    main()
