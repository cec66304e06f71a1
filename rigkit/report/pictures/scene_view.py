"""3D scenes for `viewer.js`: cameras as pyramids, boards, and clouds."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from rigkit.calibration.board_shape import BoardShape
from rigkit.calibration.result import ViewResult
from rigkit.calibration.rig.result import RigCalibration
from rigkit.core.arrays import FloatArray, sampling_step
from rigkit.geometry.rigid3 import Rigid3
from rigkit.reconstruction.reconstruct import Reconstruction

MAX_BOARDS = 400
"""Maximum number of boards drawn; more are subsampled."""
DEPTH = 0.15
"""Depth of a drawn camera, relative to the median distance of boards or points."""
SAME_PLACE = 0.01
"""Maximum difference of the entries of two poses (lengths relative to the distance) of one board seen twice."""
PYRAMID = np.array([[0.0, 0.0, 0.0], [-0.6, -0.45, 1.0], [0.6, -0.45, 1.0], [0.6, 0.45, 1.0], [-0.6, 0.45, 1.0]])
"""Tip and base of a drawn camera of depth 1."""


def scene_of(reconstruction: Reconstruction) -> dict[str, Any]:
    """Return the scene of a pair: its oriented cloud, the cameras and the board planes."""
    cloud = reconstruction.cloud
    cameras = {"camera 1": Rigid3.identity(), "camera 2": reconstruction.cam2_from_cam1.inverse()}
    planes = [
        {"board": index, "corners": _rounded(_bounding_box(cloud.points_mm[cloud.board_index == index]), 2)}
        for index in range(len(cloud.board_ids))
        if (cloud.board_index == index).sum() >= 3
    ]
    scene = _scene(cameras, np.linalg.norm(cloud.points_mm, axis=1), cloud.board_ids, planes)
    return scene | {
        "points": _rounded(cloud.points_mm, 2),
        "normals": _rounded(cloud.normals, 4),
        "board": [int(b) for b in cloud.board_index],
        "square_mm": float(np.mean([b.square_x_mm for b in reconstruction.boards] or [1.0])),
    }


def boards_scene(views: Sequence[ViewResult], boards: Sequence[BoardShape]) -> dict[str, Any]:
    """Return the scene of one camera with all views of boards."""
    return _views_scene({"camera": Rigid3.identity()}, [(view, Rigid3.identity()) for view in views], boards)


def rig_scene(rig: RigCalibration) -> dict[str, Any]:
    """Return the scene of a rig, with each board as seen by the first camera."""
    cameras: dict[str, Rigid3] = {}
    views: list[tuple[ViewResult, Rigid3]] = []
    places: dict[str, list[FloatArray]] = {}
    for camera in rig.cameras:
        rig_from_cam = camera.cam_from_rig.inverse()
        cameras[camera.name] = rig_from_cam
        for view in camera.calibration.views:
            place = (rig_from_cam @ view.cam_from_board).matrix()[:3]
            known = places.setdefault(view.board_id, [])
            # A board that several cameras see at one moment is drawn once.
            if not any(np.abs(place - other).max() < SAME_PLACE * (1.0 + np.abs(place[:, 3]).max()) for other in known):
                known.append(place)
                views.append((view, rig_from_cam))
    # A board's shape is the same in all cameras; the first one that has it is used.
    boards: dict[str, BoardShape] = {}
    for camera in rig.cameras:
        boards = {board.board_id: board for board in camera.calibration.boards} | boards
    return _views_scene(cameras, views, list(boards.values()))


def _views_scene(
    cameras: Mapping[str, Rigid3], views: Sequence[tuple[ViewResult, Rigid3]], boards: Sequence[BoardShape]
) -> dict[str, Any]:
    shapes = {board.board_id: board.points_mm for board in boards}
    # Parts of a board, each a board of its own in one image, are drawn as that board.
    wholes = {name: min((w for w in shapes if w == name or name.startswith(f"{w} part ")), key=len) for name in shapes}
    names = list(dict.fromkeys(wholes.values()))
    outlines = {name: _outline(points) for name, points in shapes.items()}
    planes = []
    for view, world_from_cam in views[:: sampling_step(len(views), MAX_BOARDS)]:
        corners = (world_from_cam @ view.cam_from_board).apply(outlines[view.board_id])
        name = f"{view.image}, {view.board_id}: {view.rms_px:.3f} px"
        planes.append({"board": names.index(wholes[view.board_id]), "corners": _rounded(corners, 2), "name": name})
    far = [np.linalg.norm(view.cam_from_board.apply(outlines[view.board_id]), axis=1).mean() for view, _ in views]
    return _scene(cameras, far, names, planes)


def _scene(
    cameras: Mapping[str, Rigid3], far_mm: Sequence[float] | FloatArray, boards: Sequence[str], planes: list[Any]
) -> dict[str, Any]:
    """Return a scene without points of cameras (world_from_cam by name) and planes at distances `far_mm`."""
    depth = DEPTH * float(np.median(far_mm)) if len(far_mm) else 1.0
    pyramids = {name: world_from_cam.apply(depth * PYRAMID) for name, world_from_cam in cameras.items()}
    return {
        "points": [],
        "normals": [],
        "board": [],
        "boards": list(boards),
        "cameras": [{"name": name, "corners": _rounded(pyramid, 2)} for name, pyramid in pyramids.items()],
        "planes": planes,
        "square_mm": 1.0,
    }


def _rounded(values: FloatArray, digits: int) -> list[list[float]]:
    """Return rows of rounded numbers for JSON."""
    return [[round(float(v), digits) for v in row] for row in values]


def _outline(points_mm: FloatArray) -> FloatArray:
    """Return the four corners (4, 3) of a board's grid, which is along x and y."""
    (x0, y0), (x1, y1) = points_mm[:, :2].min(axis=0), points_mm[:, :2].max(axis=0)
    z = float(points_mm[:, 2].mean())
    return np.array([[x0, y0, z], [x1, y0, z], [x1, y1, z], [x0, y1, z]])


def _bounding_box(points: FloatArray) -> FloatArray:
    """Return the corners (4, 3) of the bounding box, along the principal axes, of coplanar points."""
    centre = points.mean(axis=0)
    axes = np.linalg.svd(points - centre, full_matrices=False)[2][:2]
    local = (points - centre) @ axes.T
    (x0, y0), (x1, y1) = local.min(axis=0), local.max(axis=0)
    return np.asarray(centre + np.array([[x0, y0], [x1, y0], [x1, y1], [x0, y1]]) @ axes)
