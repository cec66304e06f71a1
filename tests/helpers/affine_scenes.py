"""Corners of chessboards in front of two cameras, geometry only: exact affinities, directions, chords and normals."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np

from rigkit.affine.affinities import EpipolarNormals
from rigkit.affine.normal import affines_from_normals
from rigkit.cameras.base import Camera
from rigkit.cameras.kannala_brandt import KannalaBrandt
from rigkit.cameras.pinhole import Pinhole
from rigkit.core.matches import DirectionPairs, Matches
from rigkit.geometry.projection_jacobian import pair_projection_jacobians
from rigkit.geometry.rigid3 import Rigid3, cam_from_world_look_at
from rigkit.geometry.rotation import exp_so3, skew, unit

REGULAR = Pinhole((1600, 1240), np.array([1350.0, 1350.0, 800.0, 620.0]))
FISHEYE = KannalaBrandt((1600, 1240), np.array([560.0, 556.0, 798.0, 622.0, -0.02, 0.004, -0.002, 0.0003]))
SQUARE_MM = 40.0
GRID = np.stack(np.meshgrid(np.arange(6.0), np.arange(8.0)), axis=-1).reshape(-1, 2) * SQUARE_MM


@dataclass(frozen=True)
class Corners:
    """N corners of any number of image pairs."""

    points: np.ndarray
    normals: np.ndarray
    plane: np.ndarray
    pixels1: np.ndarray
    pixels2: np.ndarray
    n1: np.ndarray
    n2: np.ndarray
    J1: np.ndarray
    J2: np.ndarray
    A21: np.ndarray
    exact1: np.ndarray
    exact2: np.ndarray
    chord1: np.ndarray
    chord2: np.ndarray

    @property
    def epipolar(self) -> EpipolarNormals:
        return EpipolarNormals(self.n1, self.n2)

    def __len__(self) -> int:
        return len(self.points)

    def directions(self, *, chords: bool = False) -> DirectionPairs:
        """Directions along rows, columns and diagonals: exact derivatives, or the paper's chords to the next corner."""
        first, second = (self.chord1, self.chord2) if chords else (self.exact1, self.exact2)
        return DirectionPairs(image1=first, image2=second, valid=np.ones(first.shape[:2], dtype=bool))

    def select(self, which: np.ndarray) -> Corners:
        return Corners(*(getattr(self, f.name)[which] for f in fields(self)))

    @staticmethod
    def join(parts: list[Corners]) -> Corners:
        return Corners(*(np.concatenate([getattr(p, f.name) for p in parts]) for f in fields(Corners)))


def see(
    camera1: Camera,
    camera2: Camera,
    cam2_from_cam1: Rigid3,
    cam1_from_boards: list[Rigid3],
    grid: np.ndarray = GRID,
    incidence: float = 0.02,
) -> Corners | None:
    """Both views of boards at the given poses; None where a corner is behind a camera or too oblique."""
    seen = []
    # Visibility of all boards first: most random poses show one of them edge-on.
    for cam1_from_board in cam1_from_boards:
        flat = np.concatenate([grid, np.zeros((len(grid), 1))], axis=1)
        points = cam1_from_board.apply(flat)
        R = cam1_from_board.rotation
        normals = np.broadcast_to(R[:, 2], points.shape) * -np.sign(R[:, 2] @ points[0])
        centre2 = cam2_from_cam1.inverse().translation_mm
        for origin in (np.zeros(3), centre2):
            if (np.sum(unit(points - origin) * normals, axis=1) > -incidence).any():
                return None
        (q1, ok1), (q2, ok2) = camera1.project(points), camera2.project(cam2_from_cam1.apply(points))
        if not (ok1.all() and ok2.all()):
            return None
        seen.append((R, points, normals, q1, q2))
    parts = []
    for plane, (R, points, normals, q1, q2) in enumerate(seen):
        m = Matches.from_cameras(camera1, camera2, q1, q2)
        E21 = skew(cam2_from_cam1.translation_mm) @ cam2_from_cam1.rotation
        e = EpipolarNormals.of_matches(m, E21)
        J1, J2 = pair_projection_jacobians(points, m.rays1, m.jacobians1, m.rays2, m.jacobians2, cam2_from_cam1)
        A21, _ = affines_from_normals(J1, J2, normals)
        steps = SQUARE_MM * np.stack([R[:, 0], R[:, 1], R[:, 0] + R[:, 1]])
        exact = [np.einsum("nij,kj->nki", J, steps) for J in (J1, J2)]
        ends = points[:, None, :] + steps
        chords = [camera1.project(ends)[0] - q1[:, None], camera2.project(cam2_from_cam1.apply(ends))[0] - q2[:, None]]
        index = np.full(len(points), plane)
        parts.append(Corners(points, normals, index, q1, q2, e.n1, e.n2, J1, J2, A21, *exact, *chords))
    return Corners.join(parts)


def corner_boards() -> list[Rigid3]:
    """world_from_board of three boards on the faces of a cube's corner: z, y and x constant."""
    offset = SQUARE_MM
    floor = np.array([[1.0, 0, 0], [0, 0, -1.0], [0, 1.0, 0]])
    side = np.array([[0, 0, 1.0], [0, 1.0, 0], [-1.0, 0, 0]])
    centres = [[1, 1, 0], [1, 0, 1], [0, 1, 1]]
    out = []
    for R, away in zip((np.eye(3), floor, side), centres, strict=True):
        middle = -np.array(away) * (offset + 3.0 * SQUARE_MM)
        out.append(Rigid3(R, middle - R @ np.array([*GRID.mean(axis=0), 0.0])))
    return out


def general_pairs(rng: np.random.Generator, trials: int, parallax_deg: tuple[float, float]) -> Corners:
    """The reference scene: two cameras 0.9 to 1.3 m from a cube's corner, roll +-30 and aim +-8 degrees."""
    parts: list[Corners] = []
    boards = corner_boards()
    while len(parts) < trials:
        (eye1, pose1), (eye2, pose2) = _camera_at_corner(rng), _camera_at_corner(rng)
        parallax = np.degrees(np.arccos(np.clip(unit(eye1) @ unit(eye2), -1.0, 1.0)))
        if not parallax_deg[0] <= parallax <= parallax_deg[1]:
            continue
        seen = see(REGULAR, REGULAR, pose2 @ pose1.inverse(), [pose1 @ b for b in boards], incidence=0.2)
        if seen is not None:
            parts.append(seen)
    return Corners.join(parts)


def _camera_at_corner(rng: np.random.Generator) -> tuple[np.ndarray, Rigid3]:
    eye = -rng.uniform(900.0, 1300.0) * unit(np.abs(rng.normal(size=3)))
    aim = exp_so3(np.radians(rng.uniform(-8.0, 8.0, 3)) * np.array([1.0, 1.0, 0.0]))
    roll = exp_so3(np.array([0.0, 0.0, np.radians(rng.uniform(-30.0, 30.0))]))
    return eye, Rigid3(roll @ aim, np.zeros(3)) @ cam_from_world_look_at(eye, np.zeros(3))


def special_boards(turn_deg: float) -> list[Rigid3]:
    """cam1_from_board of a board in front, the floor and a wall on the right, turned in their planes."""
    turn = exp_so3(np.array([0.0, 0.0, np.radians(turn_deg)]))
    centres = [[0.0, -20.0, 1200.0], [0.0, 300.0, 1000.0], [400.0, 0.0, 1000.0]]
    out = []
    for world, centre in zip(corner_boards(), centres, strict=True):
        R = world.rotation @ turn
        out.append(Rigid3(R, np.array(centre) - R @ np.array([*GRID.mean(axis=0), 0.0])))
    return out


def special_pairs(rng: np.random.Generator, trials: int, pose: str, turn_deg: float) -> Corners:
    """Planar, standard or forward pairs with a baseline of 300 mm."""
    parts = []
    for _ in range(trials):
        rotation, heading = np.eye(3), {"standard": -np.pi / 2, "forward": np.pi}.get(pose, 0.0)
        if pose == "planar":
            rotation = exp_so3(np.array([0.0, np.radians(rng.uniform(-10.0, 10.0)), 0.0]))
            heading = rng.uniform(0.0, 2.0 * np.pi)
        motion = Rigid3(rotation, 300.0 * np.array([np.sin(heading), 0.0, np.cos(heading)]))
        parts.append(see(REGULAR, REGULAR, motion, special_boards(turn_deg)))
    return Corners.join([p for p in parts if p is not None])


def turned(
    directions: DirectionPairs, sigma_deg: float, rng: np.random.Generator, images: str = "12"
) -> DirectionPairs:
    """Every direction rotated by an independent Gaussian angle, with its length unchanged."""

    def turn(d: np.ndarray) -> np.ndarray:
        angle = np.radians(sigma_deg) * rng.normal(size=d.shape[:-1])
        c, s = np.cos(angle), np.sin(angle)
        return np.stack([c * d[..., 0] - s * d[..., 1], s * d[..., 0] + c * d[..., 1]], axis=-1)

    first = turn(directions.image1) if "1" in images else directions.image1
    second = turn(directions.image2) if "2" in images else directions.image2
    return DirectionPairs(
        image1=first, image2=second, valid=directions.valid, scaled=directions.scaled, kinds=directions.kinds
    )


def angles_deg(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    cross = np.linalg.norm(np.cross(a, b), axis=-1)
    return np.degrees(np.arctan2(cross, np.sum(a * b, axis=-1)))
