"""Rendered chessboard scenes with exact corners, and the comparison of detections with them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial import cKDTree

from rigkit.cameras.base import Camera
from rigkit.cameras.kannala_brandt import KannalaBrandt
from rigkit.cameras.pinhole import Pinhole
from rigkit.core.boards import Board
from rigkit.core.detections import BoardDetection
from rigkit.geometry.rigid3 import Rigid3, cam_from_world_look_at
from rigkit.geometry.rotation import exp_so3
from rigkit.synthetic.photometry import Photometry, develop
from rigkit.synthetic.render import Optics, radiance
from rigkit.synthetic.scene import PlacedBoard, trihedral

SIZE_PX = (640, 480)


@dataclass(frozen=True)
class Scene:
    boards: tuple[PlacedBoard, ...]
    camera: Camera
    cam_from_world: Rigid3

    def image(self, rng: np.random.Generator, *, blur_px: float = 0.7, **photometry: Any) -> np.ndarray:
        # With such blur fewer sub-samples give the same image, in two thirds of the time.
        optics = Optics(blur_px, supersample=2 if blur_px >= 0.6 else 4)
        light = radiance(self.boards, self.camera, self.cam_from_world, optics=optics)
        settings = {"noise_levels": 2.0, "vignetting": 0.25, **photometry}
        return np.asarray(develop(light, Photometry(**settings), rng))

    def truth(self) -> list[tuple[np.ndarray, np.ndarray]]:
        """Return grid (N, 2) and exact pixels (N, 2) of the visible corners of each board."""
        out = []
        for placed in self.boards:
            pixels, valid = placed.see(self.camera, self.cam_from_world)
            out.append((placed.board.grid()[valid], pixels[valid]))
        return out


def regular() -> Camera:
    return Pinhole(SIZE_PX, np.array([545.0, 545.0, 318.0, 242.0]))


def fisheye() -> Camera:
    return KannalaBrandt(SIZE_PX, np.array([230.0, 230.0, 322.8, 236.8, -0.012, -0.004, 0.001, -0.0002]))


def corner_scene(
    rng: np.random.Generator, camera: Camera, distance_mm: float, *, margin_squares: float = 0.5, clearance: float = 3.0
) -> Scene:
    """Return three perpendicular boards of 8x6, all corners in view."""
    boards = trihedral(
        [Board(name, 8, 6, 50.0, 50.0) for name in "abc"], margin_squares=margin_squares, clearance_mm=clearance
    )
    target = np.concatenate([placed.points() for placed in boards]).mean(axis=0)
    for _ in range(200):
        outward = np.mean([placed.normal() for placed in boards], axis=0) + rng.uniform(-0.18, 0.18, 3)
        eye = target + distance_mm * outward / np.linalg.norm(outward)
        scene = Scene(boards, camera, cam_from_world_look_at(eye, target, -boards[1].normal()))
        inside = [((p > 8.0) & (p < np.array(SIZE_PX) - 9.0)).all() and len(p) == 48 for _, p in scene.truth()]
        if all(inside):
            return scene
    raise AssertionError("no view shows all corners")


def single(
    board: Board,
    rotation: ArrayLike,
    distance_mm: float,
    *,
    shift_mm: tuple[float, float] = (0.0, 0.0),
    **kwargs: Any,
) -> Scene:
    """Return one board with its centre at `distance_mm` in front of the regular camera, in the given rotation."""
    turn = exp_so3(np.asarray(rotation, dtype=np.float64))
    half = [0.5 * board.square_x_mm * (board.columns - 1), 0.5 * board.square_y_mm * (board.rows - 1), 0.0]
    middle = turn @ np.array(half)
    place = Rigid3(turn, np.array([*shift_mm, distance_mm]) - middle)
    return Scene((PlacedBoard(board, place, **kwargs),), regular(), Rigid3.identity())


def errors_by_place(found: BoardDetection, truth: BoardDetection) -> np.ndarray:
    """Return found minus true pixels by grid position, (N, 2): of another board they are off by whole squares."""
    return found.pixels - truth.lattice()[found.grid[:, 1], found.grid[:, 0]]


def errors_by_position(found: BoardDetection, truth: np.ndarray) -> np.ndarray:
    """Return found minus nearest true corner, (N, 2)."""
    return found.pixels - truth[cKDTree(truth).query(found.pixels)[1]]


def match(found: tuple[BoardDetection, ...], truth: list[tuple[np.ndarray, np.ndarray]]) -> list[BoardDetection]:
    """Return the detection of each true board: the one with the nearest centre."""
    return [
        min(found, key=lambda d: np.linalg.norm(d.pixels.mean(axis=0) - pixels.mean(axis=0))) for _, pixels in truth
    ]


def printed_text() -> np.ndarray:
    """Return an image of letters and symbols, which have corners similar to a board's."""
    image = np.full((300, 500), 230, np.uint8)
    for line in range(13):
        cv2.putText(image, "HHH ### xxx 8888 +++ %%% mmm " * 2, (3, 20 + 22 * line), 0, 0.5, 20, 1, cv2.LINE_AA)
    return image


def dots(size_px: tuple[int, int], radius_px: int) -> np.ndarray:
    """Return an image of dots, spaced by 30 px."""
    image = np.full(size_px[::-1], 220, np.uint8)
    for v in range(20, size_px[1], 30):
        for u in range(20, size_px[0], 30):
            cv2.circle(image, (u, v), radius_px, 30, -1, cv2.LINE_AA)
    return image
