"""Generate stereo pairs in front of boards, with exact truth for every quantity that a reconstruction estimates."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rigkit.cameras.base import Camera
from rigkit.core.arrays import FloatArray, Normals, Points
from rigkit.core.boards import Board
from rigkit.core.detections import BoardDetection
from rigkit.core.errors import DegenerateError, InputError
from rigkit.core.posetype import PoseType
from rigkit.geometry.rigid3 import Rigid3, cam_from_world_look_at
from rigkit.geometry.rotation import exp_so3, unit
from rigkit.synthetic.photometry import Photometry
from rigkit.synthetic.render import Optics, render
from rigkit.synthetic.scene import Panel, PlacedBoard, exact_detection, room_walls, trihedral

RANDOM_PAIR_TRIES = 2000
MIN_PAIR_INCIDENCE = 0.2
"""Smallest |cosine| between viewing ray and board normal, at every corner of every board in both views."""
BORDER_PX = 8.0
"""Corners keep this distance from the image's border."""
PLANAR_YAW_DEG = 10.0
"""Planar pairs: the second camera turns by at most this, about its own vertical axis."""

Image = NDArray[np.uint8] | NDArray[np.uint16]


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class StereoScene:
    """Boards, panels behind them, and two cameras.

    Attributes
    ----------
    boards, panels : in the world.
    camera1, camera2 : any models.
    cam1_from_world, cam2_from_world : poses.
    pose_type : type of the relative pose.
    """

    boards: tuple[PlacedBoard, ...]
    panels: tuple[Panel, ...]
    camera1: Camera
    camera2: Camera
    cam1_from_world: Rigid3
    cam2_from_world: Rigid3
    pose_type: PoseType

    @property
    def cam2_from_cam1(self) -> Rigid3:
        return self.cam2_from_world @ self.cam1_from_world.inverse()

    @property
    def baseline_mm(self) -> float:
        return float(np.linalg.norm(self.cam2_from_cam1.translation_mm))

    def points_in_cam1(self) -> tuple[Points, ...]:
        """Return each board's corners in the frame of camera 1, (N, 3) mm."""
        return tuple(self.cam1_from_world.apply(b.points()) for b in self.boards)

    def normals_in_cam1(self) -> Normals:
        """Return each board's unit normal in the frame of camera 1, facing it, (boards, 3)."""
        normals = []
        for placed, points in zip(self.boards, self.points_in_cam1(), strict=True):
            normal = self.cam1_from_world.rotation @ placed.normal()
            normals.append(-np.sign(normal @ points[0]) * normal)
        return np.array(normals)

    def detections(self) -> tuple[tuple[BoardDetection, ...], tuple[BoardDetection, ...]]:
        """Return the exact detections in image 1 and in image 2, with corners in the same order."""
        first = tuple(exact_detection(b, self.camera1, self.cam1_from_world) for b in self.boards)
        second = tuple(exact_detection(b, self.camera2, self.cam2_from_world) for b in self.boards)
        return first, second

    def images(
        self,
        *,
        optics: Optics | None = None,
        photometry: Photometry | None = None,
        rng: np.random.Generator | None = None,
    ) -> tuple[Image, Image]:
        """Return both images."""
        views = ((self.camera1, self.cam1_from_world), (self.camera2, self.cam2_from_world))
        first, second = (
            render(self.boards, camera, pose, panels=self.panels, optics=optics, photometry=photometry, rng=rng)
            for camera, pose in views
        )
        return first, second


def relative_pose(
    pose_type: PoseType, baseline_mm: float, rng: np.random.Generator, *, level_sigma_deg: float = 0.0
) -> Rigid3:
    """Return cam2_from_cam1 of a planar, standard or forward pair; raises InputError for the other types.

    `level_sigma_deg` is the standard deviation of the second camera's tilt about x and about z.
    """
    heading, yaw = -np.pi / 2.0, 0.0
    if pose_type is PoseType.PLANAR:
        yaw = np.radians(rng.uniform(-PLANAR_YAW_DEG, PLANAR_YAW_DEG))
        heading = rng.uniform(0.0, 2.0 * np.pi)
    elif pose_type is PoseType.FORWARD:
        heading = np.pi
    elif pose_type is not PoseType.STANDARD:
        raise InputError(f"relative pose: no single relative pose belongs to pose type '{pose_type}'")
    moved = Rigid3(exp_so3(np.array([0.0, yaw, 0.0])), baseline_mm * np.array([np.sin(heading), 0.0, np.cos(heading)]))
    tilt = np.radians(level_sigma_deg) * rng.standard_normal(2) if level_sigma_deg > 0.0 else np.zeros(2)
    return Rigid3(exp_so3(np.array([tilt[0], 0.0, tilt[1]])), np.zeros(3)) @ moved


def trihedral_pair(
    boards: Sequence[Board],
    camera: Camera,
    pose_type: PoseType,
    rng: np.random.Generator,
    *,
    camera2: Camera | None = None,
    angles_deg: tuple[float, float, float] = (90.0, 90.0, 90.0),
    baseline_mm: float = 300.0,
    parallax_deg: tuple[float, float] = (10.0, 35.0),
    distance: tuple[float, float] = (0.9, 1.5),
    level_sigma_deg: float = 0.0,
    walls: bool = True,
) -> StereoScene:
    """Return a random pair that sees all corners of three boards in the corner of a room.

    Raises DegenerateError if no such view was found: the lens is too narrow, or the baseline too long.

    Parameters
    ----------
    boards : three boards of any sizes.
    pose_type : GENERAL draws two independent views with a parallax in `parallax_deg`; the others move the second camera
        by `baseline_mm`.
    distance : range of the cameras' distance, as a multiple of that at which the boards fill the image.
    level_sigma_deg : spirit-level error of all but general pairs.
    walls : whether to add walls and a floor behind the boards.
    """
    placed = trihedral(boards, angles_deg=angles_deg)
    return random_pair(
        placed,
        camera,
        pose_type,
        rng,
        camera2=camera2,
        panels=(lambda reach_mm: room_walls(12.0 * reach_mm, angles_deg=angles_deg)) if walls else None,
        baseline_mm=baseline_mm,
        parallax_deg=parallax_deg,
        distance=distance,
        level_sigma_deg=level_sigma_deg,
    )


def random_pair(
    placed: Sequence[PlacedBoard],
    camera: Camera,
    pose_type: PoseType,
    rng: np.random.Generator,
    *,
    camera2: Camera | None = None,
    panels: Callable[[float], tuple[Panel, ...]] | None = None,
    baseline_mm: float = 300.0,
    parallax_deg: tuple[float, float] = (10.0, 35.0),
    distance: tuple[float, float] = (0.9, 1.5),
    level_sigma_deg: float = 0.0,
) -> StereoScene:
    """Return a random pair that sees all corners of boards in the room x, y, z < 0; see `trihedral_pair`.

    `panels` returns the panels behind the boards for the radius (mm) of their bounding sphere.
    """
    second_camera = camera if camera2 is None else camera2
    corners = np.concatenate([b.points() for b in placed])
    middle = 0.5 * (corners.min(axis=0) + corners.max(axis=0))
    reach = float(np.linalg.norm(corners - middle, axis=1).max())
    behind = panels(reach) if panels is not None else ()
    view = _random_view(middle, reach * _fill_factor(camera), distance, rng)
    for _ in range(RANDOM_PAIR_TRIES):
        first = view()
        if not _sees_all(placed, camera, first):
            continue
        if pose_type is PoseType.GENERAL:
            second = view()
            rays = unit(np.stack([pose.inverse().translation_mm - middle for pose in (first, second)]))
            parallax = np.degrees(np.arccos(np.clip(rays[0] @ rays[1], -1.0, 1.0)))
            fits = parallax_deg[0] <= parallax <= parallax_deg[1]
        else:
            second = relative_pose(pose_type, baseline_mm, rng, level_sigma_deg=level_sigma_deg) @ first
            fits = True
        if fits and _sees_all(placed, second_camera, second):
            return StereoScene(
                boards=tuple(placed),
                panels=behind,
                camera1=camera,
                camera2=second_camera,
                cam1_from_world=first,
                cam2_from_world=second,
                pose_type=pose_type,
            )
    raise DegenerateError(
        f"random pair: in {RANDOM_PAIR_TRIES} random views no {pose_type} pair saw all corners; "
        "use a wider lens, a shorter baseline or a larger distance"
    )


def _fill_factor(camera: Camera) -> float:
    """Return the distance, in radii of a sphere, at which it fills the shorter side of the image."""
    width, height = camera.size_px
    half_angle = min(0.5 * min(width, height) / camera.focal_px, np.radians(75.0))
    return float(1.0 / np.sin(half_angle))


def _random_view(
    middle: FloatArray, scale_mm: float, distance: tuple[float, float], rng: np.random.Generator
) -> Callable[[], Rigid3]:
    """Return a function that draws cam_from_world: in the room, looking at the boards, rolled up to 30 degrees."""

    def view() -> Rigid3:
        direction = unit(-np.abs(rng.standard_normal(3)))
        eye = middle + scale_mm * rng.uniform(*distance) * direction
        aim = middle + 0.08 * scale_mm * rng.uniform(-1.0, 1.0, 3)
        roll = exp_so3(np.array([0.0, 0.0, np.radians(rng.uniform(-30.0, 30.0))]))
        return Rigid3(roll, np.zeros(3)) @ cam_from_world_look_at(eye, aim)

    return view


def _sees_all(placed: Sequence[PlacedBoard], camera: Camera, cam_from_world: Rigid3) -> bool:
    limit = np.array(camera.size_px) - 1.0 - BORDER_PX
    for board in placed:
        pixels, valid = board.see(camera, cam_from_world)
        if not valid.all() or not ((pixels > BORDER_PX) & (pixels < limit)).all():
            return False
        rays = unit(cam_from_world.apply(board.points()))
        if not (rays @ (cam_from_world.rotation @ board.normal()) < -MIN_PAIR_INCIDENCE).all():
            return False
    return True
