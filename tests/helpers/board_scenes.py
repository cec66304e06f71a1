"""Geometry-only captures of chessboards: exact corners of random trihedral scenes, and of the recorded captures."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from helpers.data import shared_data
from rigkit.cameras.base import Camera, RadialCurve
from rigkit.cameras.kannala_brandt import KannalaBrandt
from rigkit.cameras.pinhole import Pinhole
from rigkit.core.boards import Board
from rigkit.core.detections import BoardDetection
from rigkit.geometry.rigid3 import Rigid3, cam_from_world_look_at
from rigkit.geometry.rotation import exp_so3
from rigkit.reconstruction.pairing import MatchedPair, match_pair
from rigkit.synthetic.pairs import StereoScene

SIZE_PX = (1624, 1240)
LAB_PAIRS = tuple(
    f"{lens}-{pose}" for lens in ("regular", "fisheye") for pose in ("general", "planar", "standard", "forward")
)


@dataclass(frozen=True)
class Scene:
    """Two views of some boards: exact pixels of every corner (NaN where not visible) and poses."""

    boards: tuple[Board, ...]
    camera1: Camera
    camera2: Camera
    cam1_from_board: dict[str, Rigid3]
    cam2_from_cam1: Rigid3
    pixels1: dict[str, np.ndarray]
    pixels2: dict[str, np.ndarray]
    cam1_from_world: Rigid3 | None = None


def regular_camera() -> Camera:
    return Pinhole(SIZE_PX, np.array([1356.0, 1356.0, 820.5, 605.5]))


def fisheye_camera() -> Camera:
    return KannalaBrandt(SIZE_PX, np.array([602.0, 601.0, 799.5, 626.5, -0.012, -0.004, 0.001, -0.0002]))


def visible(camera: Camera, points: np.ndarray) -> np.ndarray:
    """Pixels of points, NaN outside the image."""
    pixels, valid = camera.project(points)
    inside = valid & (pixels >= 5.0).all(axis=-1) & (pixels <= np.array(camera.size_px) - 6.0).all(axis=-1)
    return np.where(inside[..., None], pixels, np.nan)


def view(boards: tuple[Board, ...], camera: Camera, cam_from_board: dict[str, Rigid3]) -> dict[str, np.ndarray]:
    return {b.board_id: visible(camera, cam_from_board[b.board_id].apply(b.points())) for b in boards}


def trihedral_scene(rng: np.random.Generator, boards: tuple[Board, ...], camera: Camera) -> Scene:
    """Three boards on the right wall, the floor and the left wall of a corner, shifted and rotated at random in their
    planes; two cameras that look at the corner from random positions; all corners inside both images."""
    for _ in range(5000):
        cam1_from_world, cam2_from_world = _random_camera(rng), _random_camera(rng)
        world_from_board = {
            b.board_id: _on_wall(rng, b, k) for b, k in zip(boards, rng.permutation(3)[: len(boards)], strict=True)
        }
        poses1 = {k: cam1_from_world @ v for k, v in world_from_board.items()}
        poses2 = {k: cam2_from_world @ v for k, v in world_from_board.items()}
        pixels1, pixels2 = view(boards, camera, poses1), view(boards, camera, poses2)
        whole = all(np.isfinite(p).all() for p in [*pixels1.values(), *pixels2.values()])
        if whole and all(_facing(p) for p in [*poses1.values(), *poses2.values()]):
            cam2_from_cam1 = cam2_from_world @ cam1_from_world.inverse()
            return Scene(boards, camera, camera, poses1, cam2_from_cam1, pixels1, pixels2, cam1_from_world)
    raise AssertionError("no scene fits into the image")


def _random_camera(rng: np.random.Generator) -> Rigid3:
    """In the octant in front of the corner (walls x = 0 and z = 0, floor y = 0, y up as -y), 0.8 to 1.6 m away."""
    direction = np.array([1.0, -1.0, 1.0]) / np.sqrt(3.0) + rng.uniform(-0.3, 0.3, 3)
    eye = direction / np.linalg.norm(direction) * rng.uniform(800.0, 1600.0)
    roll = exp_so3(np.array([0.0, 0.0, rng.uniform(-0.5, 0.5)]))
    level = cam_from_world_look_at(eye, np.array([150.0, -150.0, 150.0]) + rng.uniform(-60, 60, 3))
    return Rigid3(roll, np.zeros(3)) @ level


def _on_wall(rng: np.random.Generator, board: Board, wall: int) -> Rigid3:
    """world_from_board: z into the wall (-x, down or -z), rotated in the plane by a quarter turn and +-20 degrees."""
    into = np.array([[-1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, -1.0]])[wall]
    along = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]])[wall]
    level = np.stack([along, np.cross(into, along), into], axis=1)
    turn = rng.integers(4) * np.pi / 2.0 + rng.uniform(-0.35, 0.35)
    rotation = level @ exp_so3(np.array([0.0, 0.0, turn]))
    centre = np.array([1.0, -1.0, 1.0]) * rng.uniform(150.0, 330.0, 3)
    centre[np.abs(into) > 0.5] = 0.0
    return Rigid3(rotation, centre - rotation @ board.points().mean(axis=0))


def _facing(cam_from_board: Rigid3, grazing: float = 0.2) -> bool:
    middle = cam_from_board.translation_mm / np.linalg.norm(cam_from_board.translation_mm)
    return bool(cam_from_board.rotation[:, 2] @ middle > grazing)


def detection(
    board: Board,
    pixels: np.ndarray,
    rng: np.random.Generator | None = None,
    sigma_px: float = 0.0,
    *,
    named: bool = False,
) -> BoardDetection:
    """A detection of the visible corners, in the board's own order, with noise."""
    seen = np.isfinite(pixels).all(axis=1)
    noise = 0.0 if rng is None else rng.normal(size=(len(pixels), 2)) * sigma_px
    noisy = (pixels + noise)[seen]
    sigma = np.full(len(noisy), sigma_px if sigma_px > 0.0 else 0.05)
    return BoardDetection(
        board.board_id if named else None, board.columns, board.rows, board.grid()[seen], noisy, sigma
    )


def lab_camera(truth: dict) -> KannalaBrandt:
    """Kannala-Brandt fitted to the ray tracer's lens, theta = k1 r + k3 r^3: accurate to about 1e-3 px."""
    lens = truth["lens_truth"]
    radius_mm = np.linspace(0.0, 4.7, 400)
    theta = sum(k * radius_mm ** (i + 1) for i, k in enumerate(lens["k"]))
    return KannalaBrandt.from_radial_curve(SIZE_PX, RadialCurve(lens["centre_px"], theta, radius_mm / lens["pixel_mm"]))


def lab_scene(name: str) -> Scene:
    """The exact corners of one recorded capture; skips the test where it is absent."""
    truth = json.loads((shared_data("lab-a") / "captures" / name / "truth.json").read_text())
    size = truth["board"]
    ids = sorted(truth["view1"])
    boards = tuple(Board(i, size["cols"], size["rows"], size["square_mm"], size["square_mm"]) for i in ids)
    camera = lab_camera(truth)
    # The captures number rows upwards; a detector's grids are right-handed, rows down.
    order = np.arange(size["rows"] * size["cols"]).reshape(size["rows"], size["cols"])[::-1].ravel()
    poses = {}
    for i in ids:
        x = np.array(truth["view1"][i]["cam_xyz_mm"])[order].reshape(size["rows"], size["cols"], 3)
        across, down = x[0, -1] - x[0, 0], x[-1, 0] - x[0, 0]
        across, down = across / np.linalg.norm(across), down / np.linalg.norm(down)
        poses[i] = Rigid3(np.stack([across, down, np.cross(across, down)], axis=1), x[0, 0])
        assert poses[i].rotation[:, 2] @ x[0, 0] > 0.0
    pixels = [{i: np.array(truth[v][i]["uv_px"])[order] for i in ids} for v in ("view1", "view2")]
    return Scene(boards, camera, camera, poses, Rigid3.from_matrix(truth["cam2_from_cam1"]), pixels[0], pixels[1])


def scrambled(detections: list[BoardDetection], rng: np.random.Generator) -> list[BoardDetection]:
    """The detections in random order, those of rotationally symmetric boards turned by 180 degrees at random."""
    return [
        d.turned(2 * int(rng.integers(2))) if (d.columns + d.rows) % 2 == 0 else d
        for d in (detections[k] for k in rng.permutation(len(detections)))
    ]


def both_views(
    scene: Scene, rng: np.random.Generator, sigma_px: float = 0.05
) -> tuple[list[BoardDetection], list[BoardDetection]]:
    """Shuffled detections, without names, of all boards in both images."""
    views = []
    for pixels in (scene.pixels1, scene.pixels2):
        found = [detection(b, pixels[b.board_id], rng, sigma_px) for b in scene.boards]
        views.append(scrambled(found, rng))
    return views[0], views[1]


def true_corners(found: BoardDetection, pixels: dict[str, np.ndarray]) -> tuple[str, np.ndarray]:
    """The true board of a detection, and the index of each of its corners there; found by position."""
    distance = {i: np.linalg.norm(p[:, None] - found.pixels[None], axis=-1) for i, p in pixels.items()}
    board_id = min(distance, key=lambda i: np.nanmax(np.nanmin(distance[i], axis=0)))
    return board_id, np.nanargmin(distance[board_id], axis=0)


def noisy_pair(
    scene: StereoScene,
    boards: Sequence[Board],
    rng: np.random.Generator,
    sigma_px: float,
    *,
    known_as: Camera | None = None,
    declared: Sequence[Board] | None = None,
) -> MatchedPair:
    """Match the boards of a scene from noisy corners, with the camera `known_as` for the scene's own, and with the
    boards `declared` for the true ones."""
    one, two = (
        [detection(b, np.array(d.pixels), rng, sigma_px) for b, d in zip(boards, exact, strict=True)]
        for exact in scene.detections()
    )
    camera1, camera2 = known_as or scene.camera1, known_as or scene.camera2
    return match_pair("made", camera1, camera2, one, two, declared or boards)
