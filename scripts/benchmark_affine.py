"""Corners a second of the affine estimators and normals on one core, and how many times a plain loop that is.

python scripts/benchmark_affine.py [--corners 1000000] [--json]
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Callable

import numpy as np

from rigkit.affine.affinities import EpipolarNormals
from rigkit.affine.normal import normals_from_affines
from rigkit.affine.registry import AFFINE_METHODS, affines_from_directions
from rigkit.affine.surface import affines_from_normals
from rigkit.cameras.pinhole import Pinhole
from rigkit.geometry.projection_jacobian import pair_projection_jacobians
from rigkit.geometry.rigid3 import Rigid3
from rigkit.geometry.rotation import exp_so3, skew, unit
from rigkit.matches import DirectionPairs, Matches

LOOP_CORNERS = 300
REPEATS = 3


def scene(
    n: int, directions: int, noise_rad: float
) -> tuple[DirectionPairs, EpipolarNormals, np.ndarray, np.ndarray, np.ndarray]:
    """Random corners with noisy directions, their epipolar normals, projection Jacobians and true affinities."""
    rng = np.random.default_rng(1)
    camera = Pinhole((1600, 1240), np.array([1350.0, 1350.0, 800.0, 620.0]))
    pose = Rigid3(exp_so3(np.array([0.05, 0.3, -0.1])), [-300.0, 40.0, 60.0])
    points = np.stack([rng.uniform(-300, 300, n), rng.uniform(-200, 200, n), rng.uniform(900, 1500, n)], axis=1)
    pixels1, pixels2 = camera.project(points)[0], camera.project(pose.apply(points))[0]
    m = Matches.from_cameras(camera, camera, pixels1, pixels2)
    epipolar = EpipolarNormals.from_rays(
        m.rays1, m.jacobians1, m.rays2, m.jacobians2, skew(pose.translation_mm) @ pose.rotation
    )
    J1, J2 = pair_projection_jacobians(points, m.rays1, m.jacobians1, m.rays2, m.jacobians2, pose)
    normals = unit(-unit(points) + 0.5 * rng.normal(size=(n, 3)))
    A21, _ = affines_from_normals(J1, J2, normals)
    angle = np.arange(directions) * np.pi / directions + rng.uniform(-0.2, 0.2, (n, directions))
    d1 = 40.0 * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    d2 = np.einsum("nij,nkj->nki", A21, d1)
    turn = noise_rad * rng.normal(size=(n, directions))
    c, s = np.cos(turn), np.sin(turn)
    d2 = np.stack([c * d2[..., 0] - s * d2[..., 1], s * d2[..., 0] + c * d2[..., 1]], axis=-1)
    pairs = DirectionPairs(d1, d2, np.ones((n, directions), dtype=bool), kinds=tuple(map(str, range(directions))))
    return pairs, epipolar, J1, J2, A21


def best_rate(function: Callable[[], object], n: int) -> float:
    """Items a second, best of a few runs."""
    times = []
    for _ in range(REPEATS):
        start = time.perf_counter()
        function()
        times.append(time.perf_counter() - start)
    return n / min(times)


def loop_affine(method: str, d1: np.ndarray, d2: np.ndarray, n1: np.ndarray, n2: np.ndarray) -> np.ndarray:
    """One corner as one would write it from the paper, with numpy's dense solvers."""
    if method in ("2SDIR", "3SDIR"):
        k = 2 if method == "2SDIR" else len(d1)
        return np.linalg.lstsq(d1[:k], d2[:k], rcond=None)[0].T
    rows = np.array(
        [np.outer([-b[1], b[0]], a).ravel() / np.hypot(*a) / np.hypot(*b) for a, b in zip(d1, d2, strict=True)]
    )
    if method == "DET3UDIR":
        B = np.fliplr(np.diag([1.0, -1.0, -1.0, 1.0]))
        values, vectors = np.linalg.eig(B @ (rows.T @ rows))
        vectors = np.real(vectors)
        shapes = vectors.T.reshape(-1, 2, 2)
        determinants = np.linalg.det(shapes)
        best = min((v, i) for i, v in enumerate(np.real(values)) if determinants[i] > 0.0)[1]
        area = np.linalg.det(d2[:2]) / np.linalg.det(d1[:2])
        # Noise can reverse the order of two directions; then there is no scale, here as in rigkit.
        A = shapes[best] * np.sqrt(area / determinants[best] if area > 0.0 else np.nan)
        return A * np.sign(np.sum(d2 * (d1 @ A.T)))
    k = 2 if method == "F2UDIR" else len(d1)
    A0 = -np.outer(n2, n1) / (n2 @ n2)
    m = np.array([-n2[1], n2[0]]) / np.hypot(*n2)
    free = np.stack([np.outer(m, [1.0, 0.0]).ravel(), np.outer(m, [0.0, 1.0]).ravel()], axis=1)
    y = np.linalg.lstsq(rows[:k] @ free, -rows[:k] @ A0.ravel(), rcond=None)[0]
    return A0 + np.outer(m, y)


def loop_normal(J1: np.ndarray, J2: np.ndarray, A: np.ndarray) -> np.ndarray:
    """One normal with numpy's dense solvers."""
    d = np.cross(J1[0], J1[1])
    d /= np.linalg.norm(d)
    h = J2 @ d
    y = (J2 @ np.linalg.pinv(J1) - A).T @ h / (h @ h)
    n = -(J1.T @ y + d)
    return n / np.linalg.norm(n)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--corners", type=int, default=1_000_000)
    parser.add_argument("--json", action="store_true")
    args = parser.parse_args()
    n = args.corners
    results = {}
    for count in (3, 6):
        directions, epipolar, J1, J2, A21 = scene(n, count, np.radians(0.3))
        for method in AFFINE_METHODS:

            def batched(method: str = method, d: DirectionPairs = directions, e: EpipolarNormals = epipolar) -> object:
                return affines_from_directions(d, method, epipolar=e, min_conditioning=0.0)

            def loop(method: str = method, d: DirectionPairs = directions, e: EpipolarNormals = epipolar) -> object:
                return [loop_affine(method, d.image1[i], d.image2[i], e.n1[i], e.n2[i]) for i in range(LOOP_CORNERS)]

            rate, slow = best_rate(batched, n), best_rate(loop, LOOP_CORNERS)
            first = affines_from_directions(directions, method, epipolar=epipolar, min_conditioning=0.0).A21[
                :LOOP_CORNERS
            ]
            difference = np.abs(np.array(loop()) - first)
            results[f"{method}, {count} directions"] = (rate, rate / slow, float(np.nanmax(difference)))
    rate = best_rate(lambda: normals_from_affines(J1, J2, A21), n)
    slow = best_rate(lambda: [loop_normal(J1[i], J2[i], A21[i]) for i in range(LOOP_CORNERS)], LOOP_CORNERS)
    loop_normals = np.array([loop_normal(J1[i], J2[i], A21[i]) for i in range(LOOP_CORNERS)])
    difference = np.abs(loop_normals - normals_from_affines(J1, J2, A21)[0][:LOOP_CORNERS])
    results["normals"] = (rate, rate / slow, float(difference.max()))
    if args.json:
        names = ("per_second", "times_a_loop", "largest_difference")
        print(json.dumps({label: dict(zip(names, row, strict=True)) for label, row in results.items()}))
        return 0
    print(f"{'':26s}{'corners/s':>12s}{'x a loop':>10s}{'difference':>12s}")
    for label, (rate, factor, difference) in results.items():
        print(f"{label:26s}{rate:12.3g}{factor:10.0f}{difference:12.1e}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
