"""OpenCV and COLMAP on the captures of the table of truth: each finds its own corners and uses its own defaults."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from benchmark_calibration_peers import opencv_fisheye, opencv_points, opencv_regular

from rigkit.cameras.base import Camera
from rigkit.cameras.brown import Brown
from rigkit.core.boards import Board
from rigkit.core.detections import BoardView
from rigkit.core.errors import DegenerateError
from rigkit.geometry.rigid3 import Rigid3
from rigkit.io.images import read_image, to_grey


def opencv_corners(path: Path, board: Board) -> BoardView | None:
    """Return the corners that cv2.findChessboardCornersSB finds, None where it finds no board."""
    image = to_grey(read_image(path))
    flags = cv2.CALIB_CB_EXHAUSTIVE | cv2.CALIB_CB_ACCURACY
    found, corners = cv2.findChessboardCornersSB(image, board.size, flags=flags)
    if not found:
        return None
    pixels = corners.reshape(-1, 2).astype(np.float64)
    if board.looks_same_turned and (pixels[-1] - pixels[0]).sum() < 0.0:
        # Which end is first is chance on such a board; from the upper left all images are read alike.
        pixels = pixels[::-1]
    return BoardView(path.name, board, board.grid(), pixels, np.ones(len(pixels)))


def opencv_views(paths: Sequence[Path], board: Board) -> tuple[list[BoardView], tuple[int, int]]:
    """Return the views of all images on which OpenCV finds the board, and the images' size."""
    height, width = read_image(paths[0]).shape[:2]
    return [view for path in paths if (view := opencv_corners(path, board)) is not None], (width, height)


def opencv_camera(views: list[BoardView], size_px: tuple[int, int], fisheye: bool) -> tuple[float, Camera]:
    """Return the RMS and the camera; a fisheye lens is given a start, half the view over half the width, without which
    cv2.fisheye.calibrate often ends at once."""
    if not fisheye:
        return opencv_regular(views, size_px)
    width, height = size_px
    f = width / np.pi
    guess = np.array([[f, 0.0, 0.5 * (width - 1)], [0.0, f, 0.5 * (height - 1)], [0.0, 0.0, 1.0]])
    return opencv_fisheye(views, size_px, guess)


def opencv_stereo(
    left: list[BoardView], right: list[BoardView], size_px: tuple[int, int]
) -> tuple[float, tuple[Camera, Camera], Rigid3]:
    """Return the RMS, both cameras and right_from_left by cv2.stereoCalibrate, started from each camera alone. Views
    are matched by the number in their images' names; boards that look the same turned are read alike in both."""
    by_number = {_number(view.image): view for view in right}
    pairs = [(view, by_number[_number(view.image)]) for view in left if _number(view.image) in by_number]
    objects, first = opencv_points([a for a, _ in pairs])
    _, second = opencv_points([b for _, b in pairs])
    K, d = [], []
    for own in ([a for a, _ in pairs], [b for _, b in pairs]):
        p = opencv_regular(own, size_px)[1].parameters
        K.append(np.array([[p[0], 0.0, p[2]], [0.0, p[1], p[3]], [0.0, 0.0, 1.0]]))
        d.append(p[4:9].copy())
    rms, K1, d1, K2, d2, R, t, *_ = cv2.stereoCalibrate(
        [o[0] for o in objects], [p[0] for p in first], [p[0] for p in second], K[0], d[0], K[1], d[1], size_px, flags=0
    )
    cameras = (_brown(size_px, K1, d1), _brown(size_px, K2, d2))
    return float(rms), cameras, Rigid3(R, np.ravel(t))


def _brown(size_px: tuple[int, int], K: np.ndarray, d: np.ndarray) -> Brown:
    return Brown(size_px, np.array([K[0, 0], K[1, 1], K[0, 2], K[1, 2], *np.ravel(d)[:5]]))


def _number(name: str) -> str:
    return "".join(c for c in Path(name).stem if c.isdigit())


def opencv_released(views: list[BoardView], size_px: tuple[int, int]) -> tuple[float, np.ndarray]:
    """Return the RMS and the board's corners by cv2.calibrateCameraRO, which frees them but for three."""
    board = views[0].board
    objects, images = opencv_points(views)
    rms, *_, released, _ = _released(objects, images, size_px, board.columns - 1)
    return float(rms), np.asarray(released, dtype=np.float64).reshape(-1, 3)


def _released(objects: list[np.ndarray], images: list[np.ndarray], size_px: tuple[int, int], fixed: int) -> Any:
    # Its stubs know no None, which asks it to make the arrays.
    untyped: Any = cv2
    found = untyped.calibrateCameraRO([o[0] for o in objects], [i[0] for i in images], size_px, fixed, None, None)
    rms, K, d, rvecs, tvecs, released, *_ = found
    return rms, K, d, rvecs, tvecs, released, None


def opencv_pair(pixels: tuple[np.ndarray, np.ndarray], cameras: tuple[Camera, Camera]) -> np.ndarray:
    """Return points (N, 3), in baselines: cv2.findEssentialMat, recoverPose and triangulatePoints."""
    flat = [_flat(p, camera) for p, camera in zip(pixels, cameras, strict=True)]
    E, _ = cv2.findEssentialMat(flat[0], flat[1], np.eye(3), cv2.RANSAC, 0.999, 1e-3)
    _, R, t, _ = cv2.recoverPose(E, flat[0], flat[1], np.eye(3))
    return _triangulated(flat, Rigid3(R, np.ravel(t)))


def colmap_pair(pixels: tuple[np.ndarray, np.ndarray], cameras: tuple[Camera, Camera]) -> np.ndarray:
    """Return points (N, 3), in baselines, by COLMAP's calibrated two-view geometry; the cameras are OpenCV's."""
    import pycolmap

    own = []
    for k, camera in enumerate(cameras):
        fx, fy, cx, cy, k1, k2, p1, p2, k3 = camera.parameters.tolist()
        parameters = [fx, fy, cx + 0.5, cy + 0.5, k1, k2, p1, p2, k3, 0.0, 0.0, 0.0]
        width, height = camera.size_px
        own.append(pycolmap.Camera(camera_id=k + 1, model="FULL_OPENCV", width=width, height=height, params=parameters))
    pairs = np.repeat(np.arange(len(pixels[0]))[:, None], 2, axis=1).astype(np.uint32)
    found = pycolmap.estimate_calibrated_two_view_geometry(
        own[0],
        pixels[0] + 0.5,
        own[1],
        pixels[1] + 0.5,
        pairs,
        pycolmap.TwoViewGeometryOptions(compute_relative_pose=True),
    )
    if found.cam2_from_cam1 is None:
        raise DegenerateError("pycolmap finds no relative pose")
    matrix = found.cam2_from_cam1.matrix()
    pose = Rigid3(matrix[:, :3], matrix[:, 3])
    return _triangulated([_flat(p, camera) for p, camera in zip(pixels, cameras, strict=True)], pose)


def _flat(pixels: np.ndarray, camera: Camera) -> np.ndarray:
    """Return the points of the plane z = 1 that pixels see, by OpenCV."""
    p = camera.parameters
    K = np.array([[p[0], 0.0, p[2]], [0.0, p[1], p[3]], [0.0, 0.0, 1.0]])
    return cv2.undistortPoints(pixels[:, None].astype(np.float64), K, p[4:9])[:, 0]


def _triangulated(flat: Sequence[np.ndarray], pose: Rigid3) -> np.ndarray:
    first = np.hstack([np.eye(3), np.zeros((3, 1))])
    second = np.column_stack([pose.rotation, pose.translation_mm])
    points = cv2.triangulatePoints(first, second, flat[0].T, flat[1].T)
    return (points[:3] / points[3]).T
