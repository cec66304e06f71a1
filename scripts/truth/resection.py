"""Held-out errors, computed alike for every tool: camera and board from the other images, only the pose refitted."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from rigkit.cameras.base import Camera
from rigkit.core.detections import BoardView
from rigkit.geometry.board_pose import board_poses
from rigkit.geometry.rigid3 import Rigid3
from rigkit.geometry.rotation import exp_so3

Views = Sequence[BoardView]
Size = tuple[int, int]

FOLDS = 5
STEPS = 30
H_RAD, H_PART = 1e-6, 1e-6
"""Steps of the differences, radians and parts of the distance."""
SETTLED = 1e-9


@dataclass(frozen=True, eq=False, slots=True)
class Fit:
    """What a tool made of some images: the camera, the RMS that it states, px 2-D, and the corners of its board
    (columns * rows, 3) in mm, None where it takes the board to be flat and as stated."""

    camera: Camera
    rms_px: float
    points_mm: np.ndarray | None = None

    def points(self, view: BoardView) -> np.ndarray:
        """Return the points of a view in the board's frame (N, 3)."""
        return view.points() if self.points_mm is None else self.points_mm[view.board.index(view.grid)]


def resected(camera: Camera, pixels: np.ndarray, points: np.ndarray, flat: np.ndarray) -> np.ndarray:
    """Return the residuals (M, 2), px, of the corners that the camera sees, at the pose of least squares."""
    rays, valid = camera.unproject(pixels)
    if valid.sum() < 4:
        return np.zeros((0, 2))
    bases = np.linalg.pinv(camera.ray_jacobian(pixels[valid])).astype(np.float64)
    pose = board_poses(rays[valid], flat[valid], bases=bases)[0].cam_from_board
    for _ in range(STEPS):
        base, seen = camera.project(pose.apply(points))
        steps = np.repeat([H_RAD, H_PART * np.linalg.norm(pose.translation_mm)], 3)
        columns = []
        for move in np.diag(steps):
            ends = [camera.project(_moved(pose, sign * move).apply(points)) for sign in (1.0, -1.0)]
            seen = seen & ends[0][1] & ends[1][1]
            columns.append((ends[0][0] - ends[1][0]) / (2.0 * move.sum()))
        J = np.stack(columns, axis=-1)[seen].reshape(-1, 6)
        step = np.linalg.lstsq(J, (pixels - base)[seen].ravel(), rcond=None)[0]
        pose = _moved(pose, step)
        if np.abs(step / steps).max() * H_RAD < SETTLED:
            break
    found, seen = camera.project(pose.apply(points))
    return np.asarray((pixels - found)[seen])


def _moved(pose: Rigid3, step: np.ndarray) -> Rigid3:
    return Rigid3(exp_so3(step[:3]) @ pose.rotation, pose.translation_mm + step[3:])


def squares(fit: Fit, views: Views) -> tuple[float, int]:
    """Return the sum of squares, px^2, and the number of corners that the camera sees."""
    residuals = [resected(fit.camera, view.pixels, fit.points(view), view.points()) for view in views]
    return float(sum((r**2).sum() for r in residuals)), sum(len(r) for r in residuals)


def rms_of(fit: Fit, views: Views) -> tuple[float, int]:
    """Return the 2-D RMS, px, of views whose poses alone are fitted, and how many corners count: a corner beyond the
    camera's field of view cannot be judged."""
    total, count = squares(fit, views)
    return float(np.sqrt(total / count)) if count else np.nan, count


def folds_of(views: Views) -> list[list[int]]:
    """Return the numbers of the views of each fold: every fifth image."""
    images = sorted({view.image for view in views})
    return [[k for k, view in enumerate(views) if images.index(view.image) % FOLDS == fold] for fold in range(FOLDS)]


def held_out_rms(views: Views, fitted: Callable[[Views], Fit]) -> tuple[float, int]:
    """Return the 2-D RMS over images that took no part, px, and the number of corners that the cameras see."""
    total, count = 0.0, 0
    for fold in folds_of(views):
        found = fitted([view for k, view in enumerate(views) if k not in fold])
        own, corners = squares(found, [views[k] for k in fold])
        total, count = total + own, count + corners
    return (float(np.sqrt(total / count)) if count else np.nan), count
