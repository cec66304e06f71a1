"""OpenCV, mrcal and COLMAP on the captures of the table of truth, each with its own defaults.

All get the corners that rigkit kept, so that calibrations and not detectors are compared; OpenCV also runs on those of
cv2.findChessboardCornersSB.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from calibrators.peers import Mrcal, opencv_fisheye, opencv_points, opencv_regular

from rigkit.cameras.base import Camera
from rigkit.cameras.brown import Brown
from rigkit.core.boards import Board
from rigkit.core.detections import BoardView
from rigkit.core.errors import DegenerateError
from rigkit.geometry.rigid3 import Rigid3
from rigkit.io.media.images import read_image, to_grey
from truth.colmap import colmap_camera
from truth.resection import Fit, Size, Views

MRCAL_LENS = "LENSMODEL_OPENCV8"
MRCAL_FISHEYE = "LENSMODEL_SPLINED_STEREOGRAPHIC_order=3_Nx=14_Ny=10_fov_x_deg=180"
"""The models that its documentation recommends, lean and rich."""


@cache
def mrcal_there() -> bool:
    return Mrcal.available()


@dataclass(frozen=True, slots=True)
class Peer:
    """A tool in the table, and in which variant."""

    tool: str
    variant: str = ""


def opencv_fit(views: Views, size_px: Size, fisheye: bool) -> Fit:
    """Return cv2.calibrateCamera's or cv2.fisheye.calibrate's camera, the board flat. The latter is given a start, half
    the view over half the width, without which it often ends at once."""
    if not fisheye:
        rms, camera = opencv_regular(list(views), size_px)
        return Fit(camera, rms)
    width, height = size_px
    f = width / np.pi
    guess = np.array([[f, 0.0, 0.5 * (width - 1)], [0.0, f, 0.5 * (height - 1)], [0.0, 0.0, 1.0]])
    rms, camera = opencv_fisheye(list(views), size_px, guess)
    return Fit(camera, rms)


def opencv_released_fit(views: Views, size_px: Size, fisheye: bool) -> Fit:
    """Return cv2.calibrateCameraRO's camera and corners: all free but three. It takes whole boards only."""
    whole = [view for view in views if len(view.grid) == view.board.corner_count]
    if fisheye or len(whole) < 3:
        raise DegenerateError("cv2.calibrateCameraRO: needs whole boards through a regular lens")
    board = whole[0].board
    objects, images = opencv_points([in_order(view) for view in whole])
    # Its stubs know no None, which asks it to make the arrays.
    untyped: Any = cv2
    rms, K, d, _, _, released, *_ = untyped.calibrateCameraRO(
        [o[0] for o in objects], [i[0] for i in images], size_px, board.columns - 1, None, None
    )
    camera = Brown(size_px, np.array([K[0, 0], K[1, 1], K[0, 2], K[1, 2], *np.ravel(d)[:5]]))
    return Fit(camera, float(rms), np.asarray(released, dtype=np.float64).reshape(-1, 3))


def in_order(view: BoardView) -> BoardView:
    """Return the view with its corners row by row."""
    order = np.lexsort((view.grid[:, 0], view.grid[:, 1]))
    return BoardView(view.image, view.board, view.grid[order], view.pixels[order], view.sigma_px[order])


RELEASED = Peer("OpenCV", "board released")
CAMERA_FITS: Mapping[Peer, Any] = {
    Peer("OpenCV"): opencv_fit,
    RELEASED: opencv_released_fit,
    Peer("COLMAP"): lambda views, size_px, fisheye: colmap_camera(views, size_px, fisheye, released=False),
    Peer("COLMAP", "points free"): lambda views, size_px, fisheye: colmap_camera(
        views, size_px, fisheye, released=True
    ),
}
"""Peers whose cameras rigkit can hold: how they fit."""


def mrcal_takes(board: Board) -> bool:
    """Say whether mrcal can have the board: its points are a square lattice."""
    steps = np.diff(board.points().reshape(board.rows, board.columns, 3)[:, :, 0], axis=1)
    return bool(np.allclose(steps, board.square_x_mm) and np.isclose(board.square_x_mm, board.square_y_mm))


def mrcal_held_out(views: Views, size_px: Size, lens: str, folds: Sequence[Sequence[int]]) -> float:
    """Return mrcal's 2-D RMS on images held out, px, the board warped as it finds it from the others."""
    with Mrcal({(k, 0): view for k, view in enumerate(views)}, size_px, lens, warp=True) as tool:
        squares, count = 0.0, 0
        for fold in folds:
            tool.run(fold)
            squares, count = squares + tool.last["squares"], count + tool.last["count"]
    return float(np.sqrt(squares / count))


def mrcal_points(views: Views, size_px: Size) -> np.ndarray:
    """Return the board's corners as mrcal has them, warped."""
    with Mrcal({(k, 0): view for k, view in enumerate(views)}, size_px, MRCAL_LENS, warp=True) as tool:
        tool.run()
        return np.array(tool.last["board"])


def mrcal_focal(views: Views, size_px: Size) -> float:
    """Return mrcal's focal length along x, px."""
    with Mrcal({(k, 0): view for k, view in enumerate(views)}, size_px, MRCAL_LENS, warp=True) as tool:
        tool.run()
        return float(tool.last["intrinsics"][0][0])


def mrcal_rig(frames: Sequence[Mapping[int, BoardView]], size_px: Size) -> tuple[float, list[Rigid3]]:
    """Return the 2-D RMS and where the cameras after the first sit, cam_from_first, from frames {camera: view}."""
    views = {(k, camera): view for k, frame in enumerate(frames) for camera, view in frame.items()}
    with Mrcal(views, size_px, MRCAL_LENS, warp=True) as tool:
        tool.run()
    mounts = [Rigid3(cv2.Rodrigues(np.array(m[:3]))[0], np.array(m[3:])) for m in tool.last["mounts"]]
    return float(np.sqrt(2.0) * tool.last["rms"]), mounts


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


def opencv_views(paths: Sequence[Path], board: Board) -> list[BoardView]:
    """Return the views of all images on which OpenCV finds the board."""
    return [view for path in paths if (view := opencv_corners(path, board)) is not None]


def opencv_stereo(pairs: Sequence[tuple[BoardView, BoardView]], size_px: Size) -> tuple[float, Rigid3]:
    """Return the RMS and second_from_first by cv2.stereoCalibrate, started from each camera alone; corners that only
    one view has are left out, for it wants them in both."""
    common = [_common(a, b) for a, b in pairs]
    common = [pair for pair in common if len(pair[0].grid) >= 6]
    objects, first = opencv_points([a for a, _ in common])
    _, second = opencv_points([b for _, b in common])
    K, d = [], []
    for own in ([a for a, _ in common], [b for _, b in common]):
        p = opencv_regular(own, size_px)[1].parameters
        K.append(np.array([[p[0], 0.0, p[2]], [0.0, p[1], p[3]], [0.0, 0.0, 1.0]]))
        d.append(p[4:9].copy())
    rms, _, _, _, _, R, t, *_ = cv2.stereoCalibrate(
        [o[0] for o in objects], [p[0] for p in first], [p[0] for p in second], K[0], d[0], K[1], d[1], size_px, flags=0
    )
    return float(rms), Rigid3(R, np.ravel(t))


def _common(first: BoardView, second: BoardView) -> tuple[BoardView, BoardView]:
    keys1, keys2 = (view.board.index(view.grid) for view in (first, second))
    _, a, b = np.intersect1d(keys1, keys2, return_indices=True)
    one, two = (
        BoardView(view.image, view.board, view.grid[own], view.pixels[own], view.sigma_px[own])
        for view, own in ((first, a), (second, b))
    )
    return one, two


def opencv_pair(pixels: tuple[np.ndarray, np.ndarray], cameras: tuple[Camera, Camera]) -> np.ndarray:
    """Return points (N, 3), in baselines: cv2.findEssentialMat, recoverPose and triangulatePoints."""
    flat = [flattened(p, camera) for p, camera in zip(pixels, cameras, strict=True)]
    E, _ = cv2.findEssentialMat(flat[0], flat[1], np.eye(3), cv2.RANSAC, 0.999, 1e-3)
    _, R, t, _ = cv2.recoverPose(E, flat[0], flat[1], np.eye(3))
    return triangulated(flat, Rigid3(R, np.ravel(t)))


def flattened(pixels: np.ndarray, camera: Camera) -> np.ndarray:
    """Return the points of the plane z = 1 that pixels see, by OpenCV."""
    p = camera.parameters
    K = np.array([[p[0], 0.0, p[2]], [0.0, p[1], p[3]], [0.0, 0.0, 1.0]])
    return cv2.undistortPoints(pixels[:, None].astype(np.float64), K, p[4:9])[:, 0]


def triangulated(flat: Sequence[np.ndarray], pose: Rigid3) -> np.ndarray:
    first = np.hstack([np.eye(3), np.zeros((3, 1))])
    second = np.column_stack([pose.rotation, pose.translation_mm])
    points = cv2.triangulatePoints(first, second, flat[0].T, flat[1].T)
    return (points[:3] / points[3]).T
