"""A second fit of a circle grid with a calibrated camera: with exact maps, and with missed circles added.

The pose of the board gives the map of the plane around every circle, at the rim of a grid as accurately as in its
middle; a map from neighbours (`local_map`) is less accurate where these are on one side only.
"""

from __future__ import annotations

import numpy as np

from rigkit.cameras.base import Camera
from rigkit.core.arrays import BoolArray, FloatArray
from rigkit.core.boards import Board
from rigkit.core.detections import BoardDetection
from rigkit.core.errors import DegenerateError
from rigkit.core.patterns.circles import Circles
from rigkit.detection.circles.certainty import centre_sigmas
from rigkit.detection.circles.find import (
    MAX_CIRCLE_GROWTH,
    MAX_CIRCLE_RESIDUAL,
    MIN_TYPICAL_CIRCLE,
    OFF_PLACE,
    like_contrast,
)
from rigkit.detection.circles.fit import CircleFit, edge_reach, fit_circles
from rigkit.detection.circles.grid import CircleGrid
from rigkit.detection.circles.local_map import NEXT
from rigkit.detection.circles.rows import rows_of
from rigkit.detection.guided.board_guide import MIN_GUIDE_CORNERS
from rigkit.detection.saddles.response import GreyImage
from rigkit.geometry.board_pose import board_pose
from rigkit.geometry.rigid3 import Rigid3
from rigkit.kernels.circles import BESIDE

MISSED_DISTANCES = 0.1
"""Largest median residual of the board's pose for the camera that took the image, in distances of neighbours."""


def seen_through(
    grey: GreyImage, found: CircleGrid, placed: BoardDetection, board: Board, camera: Camera
) -> BoardDetection:
    """Return `placed`, the grid `found` on the board, fitted with the camera's maps, and with missed circles added.

    It is returned unchanged if the camera cannot have taken the image.
    """
    pattern = board.pattern
    pose = _pose(placed, board, camera)
    if pose is None or not isinstance(pattern, Circles):
        return placed
    nearest_mm = pattern.nearest_mm(board.squares_mm)
    radius_mm = found.radius * nearest_mm if pattern.diameter_mm is None else 0.5 * pattern.diameter_mm
    grid = board.grid()
    points = board.points(grid)
    expected, maps, curvatures, valid = _maps(camera, pose, points, radius_mm)
    spacing = np.sqrt(np.abs(np.linalg.det(maps))) * nearest_mm / radius_mm
    known = np.isin(board.index(grid), board.index(placed.grid))
    pixels = np.where(known[:, None], placed.lattice()[grid[:, 1], grid[:, 0]], expected)
    missed = np.linalg.norm(pixels - expected, axis=1) / spacing
    if not np.median(missed[known]) < MISSED_DISTANCES:
        return placed
    extent = np.sqrt((maps**2).sum(axis=2))
    whole = ((pixels > extent) & (pixels < np.array([grey.shape[1], grey.shape[0]]) - 1.0 - extent)).all(axis=1)
    tried = valid & (known | whole)
    blur = np.full(int(tried.sum()), found.blur_px)
    separation = np.linalg.norm(points[tried][:, None] - points[tried], axis=2)
    near = (separation < NEXT * nearest_mm) & (separation > 0.0) & known[tried]
    surrounded = near.sum(axis=1) >= (6 if found.hexagonal else 4)
    reach = edge_reach(maps[tried], 0.5 * nearest_mm / radius_mm, blur, surrounded)
    first = np.argsort(~near, axis=1, kind="stable")[:, :BESIDE]
    beside = np.where(np.take_along_axis(near, first, axis=1), first, -1)
    fit = fit_circles(grey, pixels[tried], maps[tried], curvatures[tried], blur, reach, beside, found.uneven_px2)
    off = np.linalg.norm(fit.pixels - pixels[tried], axis=1) / spacing[tried]
    good = _sound(fit, found) & (off < OFF_PLACE)
    sigma = np.full(len(grid), np.nan)
    sigma[known] = placed.sigma_px[np.argsort(board.index(placed.grid))]
    at = np.flatnonzero(tried)[good]
    pixels[at] = fit.pixels[good]
    sigma[at] = centre_sigmas(rows_of(fit, good), grid[at], 0.0, found.radius)
    kept = np.isfinite(sigma)
    return BoardDetection(placed.board_id, *board.size, grid[kept], pixels[kept], sigma[kept])


def _pose(placed: BoardDetection, board: Board, camera: Camera) -> Rigid3 | None:
    rays, valid = camera.unproject(placed.pixels)
    if valid.sum() < MIN_GUIDE_CORNERS:
        return None
    try:
        return board_pose(rays[valid], board.points(placed.grid[valid])).cam_from_board
    except DegenerateError:
        return None


def _maps(
    camera: Camera, pose: Rigid3, points: FloatArray, radius_mm: float
) -> tuple[FloatArray, FloatArray, FloatArray, BoolArray]:
    """Return pixels (N, 2), first (N, 2, 2) and second (N, 2, 3) differences over a radius, px, and validity (N,)."""
    step = radius_mm * np.array([[0, 0], [1, 0], [-1, 0], [0, 1], [0, -1], [1, 1], [-1, -1], [1, -1], [-1, 1]])
    around = points[:, None] + np.pad(step, ((0, 0), (0, 1)))
    seen, valid = camera.project(pose.apply(around.reshape(-1, 3)))
    at = seen.reshape(len(points), len(step), 2).transpose(1, 0, 2)
    first = np.stack([at[1] - at[2], at[3] - at[4]], axis=-1) / 2.0
    mixed = (at[5] + at[6] - at[7] - at[8]) / 4.0
    second = np.stack([at[1] + at[2] - 2.0 * at[0], mixed, at[3] + at[4] - 2.0 * at[0]], axis=-1)
    fine = valid.reshape(len(points), -1).all(axis=1) & (np.abs(np.linalg.det(first)) > 1.0)
    return at[0], first, second, fine


def _sound(fit: CircleFit, found: CircleGrid) -> BoolArray:
    """Return which circles look like those of the grid."""
    contrast = np.abs(fit.contrast)
    typical = max(found.evidence.unexplained, MIN_TYPICAL_CIRCLE)
    good = fit.valid & ((fit.contrast > 0.0) == found.bright) & (np.abs(fit.growth) < MAX_CIRCLE_GROWTH).all(axis=1)
    good &= like_contrast(fit, found.contrast, found.share)
    return np.asarray(good & (fit.residual < MAX_CIRCLE_RESIDUAL * typical * np.maximum(contrast, 1e-9)))
