"""Calibrate from boards with COLMAP's bundle adjustment (Ceres), with the board's corners as points.

A board that moves in front of a fixed camera is equivalent to a fixed world and a moving camera: each image is a pose,
each corner a point seen in all images. The initial values are OpenCV's.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import cv2
import numpy as np
from calibrators.peers import opencv_fisheye, opencv_regular

from rigkit.cameras.base import Camera
from rigkit.cameras.brown import Brown
from rigkit.cameras.kannala_brandt import KannalaBrandt
from rigkit.core.detections import BoardView
from rigkit.core.errors import DegenerateError
from rigkit.geometry.board_pose import board_poses
from rigkit.geometry.rigid3 import Rigid3
from truth.resection import Fit, Size, Views

HALF = 0.5
"""Its pixels count from the corner of the first, ours from its centre."""


def colmap_camera(views: Views, size_px: Size, fisheye: bool, *, released: bool) -> Fit:
    """Return camera and board by bundle adjustment: model OPENCV or OPENCV_FISHEYE, the board's points as stated or
    free."""
    import pycolmap

    if fisheye and released:
        raise DegenerateError("COLMAP: a free board is tried with regular lenses only")
    start = _start(views, size_px, fisheye)
    model = pycolmap.Reconstruction()
    model.add_camera_with_trivial_rig(_colmap_camera(pycolmap, 1, start))
    for k, view in enumerate(views):
        image = pycolmap.Image(name=f"{k}", keypoints=view.pixels + HALF, camera_id=1, image_id=k + 1)
        model.add_image_with_trivial_frame(image, _rigid(pycolmap, _pose(start, view)))
    _solve(pycolmap, model, [{k + 1: view} for k, view in enumerate(views)], free=released)
    camera = _camera(model.cameras[1], size_px, fisheye)
    board = views[0].board
    points = np.array([model.points3D[j + 1].xyz for j in range(board.corner_count)]) if released else None
    return Fit(camera, float(model.compute_mean_reprojection_error()), points)


def colmap_rig(frames: Sequence[Mapping[int, BoardView]], size_px: Size) -> list[Rigid3]:
    """Return where the cameras after the first sit, cam_from_first, from frames {camera: view}; board as stated."""
    import pycolmap

    names = sorted({camera for frame in frames for camera in frame})
    starts = {c: _start([frame[c] for frame in frames if c in frame], size_px, False) for c in names}
    model = pycolmap.Reconstruction()
    rig = pycolmap.Rig(rig_id=1)
    for c in names:
        model.add_camera(_colmap_camera(pycolmap, c + 1, starts[c]))
        sensor = pycolmap.sensor_t(type=pycolmap.SensorType.CAMERA, id=c + 1)
        if c == names[0]:
            rig.add_ref_sensor(sensor)
        else:
            both = next(frame for frame in frames if c in frame and names[0] in frame)
            pose = _pose(starts[c], both[c]) @ _pose(starts[names[0]], both[names[0]]).inverse()
            rig.add_sensor(sensor, _rigid(pycolmap, pose))
    model.add_rig(rig)
    shown: list[dict[int, BoardView]] = []
    number = 0
    for k, views in enumerate(frames):
        if names[0] not in views:
            continue
        frame = pycolmap.Frame(frame_id=k + 1, rig_id=1)
        ids = {}
        for c, view in views.items():
            number += 1
            ids[number] = (c, view)
            frame.add_data_id(pycolmap.data_t(pycolmap.sensor_t(type=pycolmap.SensorType.CAMERA, id=c + 1), number))
        frame.rig_from_world = _rigid(pycolmap, _pose(starts[names[0]], views[names[0]]))
        model.add_frame(frame)
        for image_id, (c, view) in ids.items():
            image = pycolmap.Image(name=f"{image_id}", keypoints=view.pixels + HALF, camera_id=c + 1, image_id=image_id)
            image.frame_id = k + 1
            model.add_image(image)
        model.register_frame(k + 1)
        shown.append({image_id: view for image_id, (_, view) in ids.items()})
    _solve(pycolmap, model, shown, free=False, rig=True)
    out = []
    for c in names[1:]:
        sensor = pycolmap.sensor_t(type=pycolmap.SensorType.CAMERA, id=c + 1)
        matrix = _there(model.rigs[1].sensor_from_rig(sensor)).matrix()
        out.append(Rigid3(matrix[:, :3], matrix[:, 3]))
    return out


def colmap_pair(pixels: tuple[np.ndarray, np.ndarray], cameras: tuple[Camera, Camera]) -> Rigid3:
    """Return cam2_from_cam1, the baseline of unit length, by COLMAP's calibrated two-view geometry."""
    import pycolmap

    own = [_colmap_camera(pycolmap, k + 1, camera) for k, camera in enumerate(cameras)]
    pairs = np.repeat(np.arange(len(pixels[0]))[:, None], 2, axis=1).astype(np.uint32)
    options = pycolmap.TwoViewGeometryOptions(compute_relative_pose=True)
    found = pycolmap.estimate_calibrated_two_view_geometry(
        own[0], pixels[0] + HALF, own[1], pixels[1] + HALF, pairs, options
    )
    matrix = _there(found.cam2_from_cam1).matrix()
    return Rigid3(matrix[:, :3], matrix[:, 3])


def _solve(
    pycolmap: Any, model: Any, frames: Sequence[Mapping[int, BoardView]], *, free: bool, rig: bool = False
) -> None:
    """Add the board's corners as points that the images {id: view} see, and refine everything; points free or not."""
    seen: dict[int, list[tuple[int, int]]] = {}
    board = next(iter(frames[0].values())).board
    for frame in frames:
        for image_id, view in frame.items():
            for n, j in enumerate(board.index(view.grid).tolist()):
                seen.setdefault(j, []).append((image_id, n))
    ids = {}
    points = board.points()
    for j in sorted(seen):
        track = pycolmap.Track()
        for image_id, n in seen[j]:
            track.add_element(image_id, n)
        ids[j] = model.add_point3D(points[j], track)
    options = pycolmap.BundleAdjustmentOptions()
    options.refine_focal_length = options.refine_principal_point = options.refine_extra_params = True
    options.refine_sensor_from_rig = rig
    options.print_summary = False
    config = pycolmap.BundleAdjustmentConfig()
    for image_id in model.images:
        config.add_image(image_id)
    if free:
        config.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
    else:
        for point_id in ids.values():
            config.add_constant_point(point_id)
    pycolmap.create_default_ceres_bundle_adjuster(options, config, model).solve()
    model.update_point_3d_errors()


def _start(views: Views, size_px: Size, fisheye: bool) -> Camera:
    """Return OpenCV's camera, with no third radial term; of a fisheye lens half the view over half the width."""
    if fisheye:
        width, height = size_px
        guess = np.array([width / np.pi, width / np.pi, 0.5 * (width - 1), 0.5 * (height - 1), 0.0, 0.0, 0.0, 0.0])
        try:
            K = np.array([[guess[0], 0.0, guess[2]], [0.0, guess[1], guess[3]], [0.0, 0.0, 1.0]])
            return opencv_fisheye(list(views), size_px, K)[1]
        except cv2.error:
            return KannalaBrandt(size_px, guess)
    p = opencv_regular(list(views), size_px)[1].parameters.copy()
    return Brown(size_px, p[:8])


def _pose(camera: Camera, view: BoardView) -> Rigid3:
    rays, valid = camera.unproject(view.pixels)
    return board_poses(rays[valid], view.points()[valid])[0].cam_from_board


def _there(pose: Any) -> Any:
    if pose is None:
        raise DegenerateError("COLMAP: it has no pose")
    return pose


def _rigid(pycolmap: Any, pose: Rigid3) -> Any:
    return pycolmap.Rigid3d(np.column_stack([pose.rotation, pose.translation_mm]))


def _colmap_camera(pycolmap: Any, number: int, camera: Camera) -> Any:
    width, height = camera.size_px
    parameters = camera.parameters.copy()
    parameters[2:4] += HALF
    if isinstance(camera, KannalaBrandt):
        model = "OPENCV_FISHEYE"
    elif len(parameters) == 8:
        model = "OPENCV"
    else:
        model, parameters = "FULL_OPENCV", np.concatenate([parameters, np.zeros(3)])
    return pycolmap.Camera(camera_id=number, model=model, width=width, height=height, params=parameters.tolist())


def _camera(found: Any, size_px: Size, fisheye: bool) -> Camera:
    parameters = np.array(found.params)
    parameters[2:4] -= HALF
    return KannalaBrandt(size_px, parameters) if fisheye else Brown(size_px, parameters)
