"""Random pairs of views with exact geometry: points on small tilted facets, their affinities, both with noise."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from rigkit.cameras.base import Camera
from rigkit.cameras.kannala_brandt import KannalaBrandt
from rigkit.cameras.pinhole import Pinhole
from rigkit.core.boards import Board
from rigkit.core.matches import Matches
from rigkit.geometry.rigid3 import Rigid3
from rigkit.geometry.rotation import angle_between, exp_so3, rotation_angle, unit
from rigkit.relative_pose.solvers.estimate import EpipolarEstimate

REGULAR = Pinhole((1624, 1240), np.array([1350.0, 1340.0, 800.0, 620.0]))
FISHEYE = KannalaBrandt((1624, 1240), np.array([420.0, 418.0, 810.0, 622.0, -0.02, 0.004, -0.002, 0.0003]))


def pose_of(kind: str, rng: np.random.Generator) -> Rigid3:
    """A random relative pose of this kind, baseline 300 mm."""
    if kind == "planar":
        phi = rng.uniform(0.0, 2.0 * np.pi)
        return Rigid3(exp_so3([0.0, rng.uniform(-0.17, 0.17), 0.0]), [300 * np.sin(phi), 0.0, 300 * np.cos(phi)])
    if kind == "standard":
        return Rigid3(np.eye(3), [-300.0, 0.0, 0.0])
    if kind == "forward":
        return Rigid3(np.eye(3), [0.0, 0.0, -300.0])
    rotation = np.zeros(3) if kind == "translation" else rng.normal(size=3) * 0.2
    return Rigid3(exp_so3(rotation), unit(rng.normal(size=3) * [1.0, 1.0, 0.5]) * 300.0)


def pair(
    rng: np.random.Generator,
    count: int = 30,
    kind: str = "general",
    *,
    noise_px: float = 0.0,
    sigma_A: float | None = None,
    camera: Camera = REGULAR,
    pose: Rigid3 | None = None,
) -> tuple[Matches, Rigid3, np.ndarray]:
    """Matches, true pose, points. `sigma_A` 0 gives exact affinities with a nominal sigma; None gives none."""
    given = pose
    points: list[np.ndarray] = []
    pose = pose_of(kind, rng) if pose is None else pose
    drawn = 0
    while len(points) < count:
        drawn += 1
        if given is None and drawn > 40 * (len(points) + 5):
            # The fields of view hardly overlap: another pose.
            pose, points, drawn = pose_of(kind, rng), [], 0
        if camera is FISHEYE:
            x = unit(rng.normal(size=3) * [1, 1, 0.7]) * rng.uniform(600, 2000)
        else:
            x = rng.uniform([-500, -400, 800], [500, 400, 2000])
        q, ok = camera.project(np.stack([x, pose.apply(x)]))
        if ok.all() and (q > 0).all() and (q < camera.size_px).all():
            points.append(x)
    X = np.array(points)
    normals = unit(-unit(X) + 0.5 * rng.normal(size=X.shape))
    q1, _, J1, _ = camera.project_with_jacobians(X)
    q2, _, J2, _ = camera.project_with_jacobians(pose.apply(X))
    tangents = np.linalg.svd(normals[:, None, :])[2][:, 1:].swapaxes(1, 2)
    A = (J2 @ pose.rotation @ tangents) @ np.linalg.inv(J1 @ tangents)
    extra = {}
    if sigma_A is not None:
        extra = {"A21": A + rng.normal(size=A.shape) * sigma_A, "sigma_A": np.full(count, max(sigma_A, 1e-6))}
    sigma = np.full(count, max(noise_px, 1e-6))
    noise1, noise2 = (rng.normal(size=q1.shape) * noise_px for _ in range(2))
    return (
        Matches.from_cameras(camera, camera, q1 + noise1, q2 + noise2, sigma1_px=sigma, sigma2_px=sigma, **extra),
        pose,
        X,
    )


def pictures(rng: np.random.Generator, points: np.ndarray, pose: Rigid3, noise_px: float = 0.3) -> Matches:
    """Matches of those of the points that are in both images of the regular camera."""
    q1, q2 = (REGULAR.project(x)[0] + noise_px * rng.normal(size=(len(x), 2)) for x in (points, pose.apply(points)))
    seen = ((q1 > 0.0) & (q2 > 0.0) & (q1 < REGULAR.size_px) & (q2 < REGULAR.size_px)).all(axis=1)
    sigma = np.full(int(seen.sum()), max(noise_px, 1e-6))
    return Matches.from_cameras(REGULAR, REGULAR, q1[seen], q2[seen], sigma1_px=sigma, sigma2_px=sigma)


def plane_in_sight(rng: np.random.Generator, noise_px: float = 0.3) -> tuple[Matches, Rigid3]:
    """Matches of one slanted plane seen from general positions, 50 to 150 of them, and the true relative pose."""
    while True:
        pose = Rigid3(exp_so3(0.1 * rng.normal(size=3)), unit(rng.normal(size=3) * [1.0, 1.0, 0.5]) * 250.0)
        normal = unit(np.append(0.5 * rng.normal(size=2), 1.0))
        across = rng.uniform([-500.0, -400.0], [500.0, 400.0], (150, 2))
        depth = (1200.0 * normal[2] - across @ normal[:2]) / normal[2]
        m = pictures(rng, np.column_stack([across, depth]), pose, noise_px)
        if len(m) >= 50:
            return m, pose


def joined(first: Matches, second: Matches) -> Matches:
    """Matches of both sets, without affinities."""
    names = ("pixels1", "pixels2", "rays1", "rays2", "jacobians1", "jacobians2", "sigma1_px", "sigma2_px")
    columns = {
        name: np.concatenate([getattr(first, name), getattr(second, name)]) for name in (*names, "board_index", "grid")
    }
    return Matches(**columns)


BOARDS = (Board("a", 8, 6, 40.0, 40.0), Board("b", 7, 6, 40.0, 41.0), Board("c", 8, 5, 40.0, 40.0))


def board_pair(
    rng: np.random.Generator,
    pose: Rigid3,
    noise_px: float,
    camera: Camera = REGULAR,
    boards: Sequence[Board] = BOARDS,
) -> tuple[Matches, np.ndarray]:
    """Matches of three perpendicular boards about 1 m away, and their points."""
    turn = exp_so3([0.0, 0.0, np.radians(25.0)])
    frames = [
        Rigid3(turn, [0.0, -20.0, 1200.0]),
        Rigid3(exp_so3([np.pi / 2, 0.0, 0.0]) @ turn, [0.0, 300.0, 1000.0]),
        Rigid3(exp_so3([0.0, np.pi / 2, 0.0]) @ turn, [400.0, 0.0, 1000.0]),
    ]
    X, index, grid = [], [], []
    for b, (board, frame) in enumerate(zip(boards, frames, strict=True)):
        local = board.points()
        X.append(frame.apply(local - local.mean(axis=0)))
        index.append(np.full(board.corner_count, b))
        grid.append(board.grid())
    points, board_index, cells = np.concatenate(X), np.concatenate(index), np.concatenate(grid)
    (q1, ok1), (q2, ok2) = camera.project(points), camera.project(pose.apply(points))
    seen = ok1 & ok2
    sigma = np.full(seen.sum(), max(noise_px, 1e-6))
    matches = Matches.from_cameras(
        camera,
        camera,
        q1[seen] + rng.normal(size=(seen.sum(), 2)) * noise_px,
        q2[seen] + rng.normal(size=(seen.sum(), 2)) * noise_px,
        sigma1_px=sigma,
        sigma2_px=sigma,
        board_index=board_index[seen],
        grid=cells[seen],
    )
    return matches, points[seen]


def affinities(matches: Matches) -> np.ndarray:
    """The affinities of matches; fails where there are none."""
    assert matches.A21 is not None
    return matches.A21


def pixel_fundamental(estimate: EpipolarEstimate) -> np.ndarray:
    """The fundamental matrix in pixels of an estimate from perspective views."""
    assert estimate.F21 is not None
    return estimate.F21


def pose_errors_deg(found: Rigid3, true: Rigid3) -> tuple[float, float]:
    """Angle of the rotation and of the translation's direction, degrees."""
    turn = rotation_angle(found.rotation @ true.rotation.T)
    lean = angle_between(found.translation_mm, true.translation_mm)
    return float(np.degrees(turn)), float(np.degrees(lean))


def same_up_to_sign(a: np.ndarray, b: np.ndarray) -> float:
    """Return the largest difference of two matrices that are equal up to sign."""
    return float(min(np.abs(a - b).max(), np.abs(a + b).max()))
